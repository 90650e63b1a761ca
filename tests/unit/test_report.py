"""Pictures show what they are given, in the colours of the legend, and touch nothing else."""

import io
import subprocess
import sys

import numpy as np
import pytest
from matplotlib import image
from matplotlib.colors import to_rgb

from sl3d_slam.geometry.se3 import exp, from_yaw, invert, transform_points
from sl3d_slam.report.line_drawing import is_standing
from sl3d_slam.report.pictures import (
    draw_lines,
    draw_map,
    draw_registration,
    draw_relocalization,
    draw_trajectory,
)
from sl3d_slam.report.scan_pictures import to_angles_deg
from sl3d_slam.report.style import (
    BLACK,
    BLUE,
    GREEN,
    KIND_COLOURS,
    ORANGE,
    PURPLE,
    VERMILION,
    height_shade,
    nice_length,
    page_size,
)
from sl3d_slam.report.summary import summary_table
from sl3d_slam.types import LineKind, LineSet, LoopRecord, Trajectory


def trajectory(T_world_lidar):
    return Trajectory(0.1 * np.arange(len(T_world_lidar)), T_world_lidar)


def loop_drive(num_poses=120, turn_error_rad=0.0):
    """Drive once around a circle of 240 m."""
    step = exp(np.array([0.0, 0.0, 2.0 * np.pi / num_poses + turn_error_rad, 2.0, 0.0, 0.0]))
    poses = [from_yaw(0.4, np.array([7.0, -3.0, 0.5]))]
    for _ in range(num_poses - 1):
        poses.append(poses[-1] @ step)
    return np.array(poses)


def lines_of(kind, rng, count=12, standing=True):
    foot = np.column_stack([rng.uniform(-30, 30, (count, 2)), np.full(count, -1.7)])
    tip = foot + np.array([0.0, 0.0, 5.0] if standing else [6.0, 2.0, 0.0])
    return LineSet(
        np.stack([foot, tip], axis=1),
        np.zeros((count, 0), np.float32),
        np.full(count, 9, np.int64),
        np.full(count, kind, np.uint8),
    )


def no_lines():
    return lines_of(LineKind.POLE, np.random.default_rng(0), count=0)


def count_pixels(png, colour):
    """Count the pixels of exactly one colour (0.01: 8-bit rounding)."""
    pixels = image.imread(io.BytesIO(png))[:, :, :3]
    return int((np.abs(pixels - to_rgb(colour)).max(axis=2) < 0.01).sum())


def loop(query, target, status):
    return LoopRecord(query, target, np.eye(4), 12, status, "")


def test_trajectory_shows_truth_odometry_and_result():
    truth = loop_drive()
    odometry = trajectory(loop_drive(turn_error_rad=0.004))
    png = draw_trajectory(trajectory(truth), odometry, truth, [], "simulated")
    assert png.startswith(b"\x89PNG\r\n\x1a\n")
    assert count_pixels(png, BLUE) > 500
    assert count_pixels(png, ORANGE) > 500


def test_trajectory_without_truth_and_loops_is_drawn():
    odometry = trajectory(loop_drive(turn_error_rad=0.004))
    png = draw_trajectory(trajectory(loop_drive()), odometry, None, [], "")
    assert count_pixels(png, ORANGE) > 500


@pytest.mark.parametrize(("status", "colour"), [("accepted", GREEN), ("revoked", PURPLE)])
def test_loops_are_drawn_in_the_colour_of_their_status(status, colour):
    run = trajectory(loop_drive())
    with_loops = draw_trajectory(run, run, None, [loop(110, 5, status), loop(90, 30, status)], "")
    without = draw_trajectory(run, run, None, [loop(110, 5, "rejected")], "")
    assert count_pixels(with_loops, colour) > 100
    assert count_pixels(without, colour) == 0


def test_same_input_gives_the_same_bytes(rng):
    run, lines = trajectory(loop_drive()), lines_of(LineKind.POLE, rng)
    assert draw_map(lines, run, "a") == draw_map(lines, run, "a")


@pytest.mark.parametrize("kind", list(LineKind))
@pytest.mark.parametrize("standing", [True, False])
def test_map_draws_each_kind_in_its_own_colour(rng, kind, standing):
    png = draw_map(lines_of(kind, rng, standing=standing), trajectory(loop_drive()), "simulated")
    for other, colour in KIND_COLOURS.items():
        if other == kind:
            assert count_pixels(png, colour) > 50
        elif other != LineKind.UNKNOWN:  # grey also comes from smoothed black text
            assert count_pixels(png, colour) == 0


def test_map_without_lines_and_of_one_pose_is_drawn():
    one_pose = trajectory(loop_drive()[:1])
    assert count_pixels(draw_map(no_lines(), one_pose, ""), BLACK) > 0


def test_lines_of_a_scan_are_seen_from_above_and_all_around(rng):
    points = rng.uniform(-30, 30, (3000, 3)) * [1.0, 1.0, 0.1]
    pole = lines_of(LineKind.POLE, rng, count=1)
    behind = LineSet(
        np.array([[[-10.0, -4.0, 0.0], [-10.0, 4.0, 0.0]]]),  # crosses the cut at 180 degrees
        np.zeros((1, 0), np.float32),
        np.ones(1, np.int64),
        np.full(1, LineKind.OTHER_EDGE, np.uint8),
    )
    assert count_pixels(draw_lines(points, pole, "t"), VERMILION) > 100
    around = image.imread(io.BytesIO(draw_lines(points, behind, "t")))[:, :, :3]
    green = (np.abs(around - to_rgb(GREEN)).max(axis=2) < 0.01)[int(0.75 * len(around)) :]
    width = green.shape[1]
    assert green[:, : width // 4].any()
    assert green[:, -width // 4 :].any()
    assert not green[:, width // 3 : 2 * width // 3].any(), "a line went the long way round"


def test_empty_scan_is_drawn():
    assert draw_lines(np.empty((0, 3)), no_lines(), "nothing").startswith(b"\x89PNG")


def test_registration_lays_the_source_on_the_target(rng):
    # The source is the target seen from elsewhere; laid on it, hardly any target colour stays.
    T_target_source = from_yaw(0.8, np.array([9.0, -4.0, 0.3]))
    target = rng.uniform(-30, 30, (4000, 3)) * [1.0, 1.0, 0.2]
    source = transform_points(invert(T_target_source), target)
    clouds, lines = (source, target), (no_lines(), no_lines())
    matches = np.empty((0, 2), np.int64)
    right = draw_registration(clouds, lines, matches, T_target_source, "right")
    swapped = draw_registration(clouds, lines, matches, invert(T_target_source), "wrong")
    assert count_reddish(right) < 0.75 * count_reddish(swapped)
    failed = draw_registration(clouds, lines, matches, None, "failed")
    assert failed.startswith(b"\x89PNG")


def count_reddish(png):
    pixels = image.imread(io.BytesIO(png))[:, :, :3]
    return int((pixels[:, :, 0] - pixels[:, :, 2] > 0.1).sum())


def test_relocalization_shows_the_true_pose_only_where_it_is_known(rng):
    T_map_keyframe, lines = loop_drive(), lines_of(LineKind.VERTICAL_EDGE, rng)
    T_map_lidar = T_map_keyframe[40]
    points = rng.uniform(-40, 40, (2000, 3))
    T_truth = T_map_lidar @ from_yaw(0.3, np.array([5.0, 2.0, 0.0]))
    known = draw_relocalization(lines, T_map_keyframe, points, T_map_lidar, T_truth, "simulated")
    unknown = draw_relocalization(lines, T_map_keyframe, points, T_map_lidar)
    assert count_pixels(known, PURPLE) > 100
    assert count_pixels(unknown, PURPLE) == 0


def test_drawing_needs_no_screen_and_no_global_state():
    code = (
        "import sys, numpy as np\n"
        "from sl3d_slam.report.pictures import draw_trajectory\n"
        "assert 'matplotlib' not in sys.modules\n"
        "from sl3d_slam.types import Trajectory\n"
        "run = Trajectory(np.arange(3.0), np.tile(np.eye(4), (3, 1, 1)))\n"
        "draw_trajectory(run, run, None, [], '')\n"
        "assert 'matplotlib.pyplot' not in sys.modules\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_angles_are_those_of_the_compass_of_the_sensor():
    points = np.array([[5.0, 0.0, 0.0], [0.0, 2.0, 0.0], [-1.0, -1.0, 0.0], [3.0, 4.0, 5.0]])
    expected = [[0.0, 0.0], [90.0, 0.0], [-135.0, 0.0], [np.degrees(np.arctan2(4, 3)), 45.0]]
    np.testing.assert_allclose(to_angles_deg(points), expected, atol=1e-12)


def test_standing_lines_are_the_steep_ones(rng):
    slopes = np.radians([0.0, 50.0, 56.0, 90.0])
    ends = np.stack([np.cos(slopes), np.zeros(4), np.sin(slopes)], axis=1)
    segments = np.stack([np.zeros((4, 3)), ends], axis=1)
    np.testing.assert_array_equal(is_standing(segments), [False, False, True, True])
    np.testing.assert_array_equal(is_standing(segments[:, ::-1]), [False, False, True, True])


@pytest.mark.parametrize(
    ("length", "expected"), [(1.0, 1.0), (9.9, 5.0), (20.0, 20.0), (0.037, 0.02), (4999.0, 2000.0)]
)
def test_scale_bars_have_round_lengths(length, expected):
    assert nice_length(length) == pytest.approx(expected)


def test_page_follows_the_area_but_is_never_a_strip():
    assert page_size(np.array([300.0, 200.0]), 9.0) == pytest.approx((9.0, 6.0))
    assert page_size(np.array([1000.0, 10.0]), 9.0) == pytest.approx((9.0, 4.5))
    assert page_size(np.array([0.0, 10.0]), 9.0) == pytest.approx((4.5, 9.0))


def test_ground_is_faint_and_what_stands_is_dark():
    heights_m = np.array([-1.7] * 60 + [-1.6] * 20 + [0.8] * 10 + [6.0] * 10)
    shade = height_shade(heights_m)
    assert shade[0] == 0.0
    assert shade[60] < 0.05
    assert shade[-1] == 1.0
    assert height_shade(np.empty(0)).shape == (0,)


def test_summary_names_what_is_known_and_leaves_out_what_is_not():
    metrics = {
        "num_scans": 1101,
        "ate_rmse_m": 0.1234,
        "odometry_ate_rmse_m": None,
        "loops_accepted": 0,
        "stages": {"odometry": {"mean_ms": 31.25, "p99_ms": 48.0}},
    }
    table = summary_table(metrics, "simulated")
    rows = list(zip(*(column.cells for column in table.columns), strict=True))
    assert rows == [
        ("scans", "1101"),
        ("error against the truth (ATE)", "0.12 m"),
        ("loops accepted", "0"),
        ("odometry", "31.2 ms, 99 % below 48.0 ms"),
    ]

"""Two scans, no first guess: synthetic poles with known poses, and real streets."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sl3d_slam import registration
from sl3d_slam.config import MatchingSettings
from sl3d_slam.errors import InputError
from sl3d_slam.geometry.se3 import (
    distance_m,
    from_yaw,
    invert,
    make_transform,
    rotation_angle_rad,
    transform_points,
)
from sl3d_slam.lines.extract import LineExtractor
from sl3d_slam.matching.alone import lines_log_odds
from sl3d_slam.matching.prepared import PreparedView
from sl3d_slam.matching.seeds import distinct
from sl3d_slam.matching.views import make_view
from sl3d_slam.registration import register_lines, register_views
from sl3d_slam.simulation.drive import simulate_drive
from sl3d_slam.types import LineSet

T_TRUE = from_yaw(np.radians(137.0), np.array([8.0, -5.0, 0.0]))


def line_set(endpoints):
    count = len(endpoints)
    return LineSet(endpoints, np.zeros((count, 0), np.float32), np.full(count, 20, np.int64))


def poles(xy):
    ends = [np.column_stack([xy, np.full(len(xy), z)]) for z in (-1.5, 3.0)]
    return line_set(np.stack(ends, axis=1))


def error(T_truth, T):
    T_difference = invert(T_truth) @ T
    return distance_m(T_difference), np.degrees(rotation_angle_rad(T_difference))


def test_lines_alone_find_a_known_pose_and_show_that_the_height_is_free(rng):
    target = poles(rng.uniform(-35, 35, (14, 2)))
    source = poles(rng.uniform(-35, 35, (4, 2)))
    seen = target.take(np.arange(10)).transformed(invert(T_TRUE))
    source = line_set(np.concatenate([seen.endpoints, source.endpoints]))
    result = register_lines(source, target)
    assert result.success
    error_m, error_deg = error(T_TRUE, result.T_target_source)
    assert error_m < 1e-3
    assert error_deg < 1e-2
    assert result.matches[:, 0].tolist()[:10] == result.matches[:, 1].tolist()[:10]
    assert result.num_inliers == len(result.matches) >= 10
    np.testing.assert_allclose(result.information[:, 5], 0.0, atol=1e-3)  # z
    assert np.linalg.matrix_rank(result.information) == 5


@pytest.mark.parametrize("num_lamps", [5, 8, 9, 12, 20])
def test_evenly_spaced_lamps_are_refused(num_lamps):
    lamps = np.column_stack([np.arange(num_lamps) * 10.0, np.zeros(num_lamps)])
    result = register_lines(poles(lamps), poles(lamps))
    assert not result.success
    assert result.T_target_source is None
    assert "another place" in result.reason


def test_odds_of_lines_alone_rise_with_lines_and_fall_with_gaps_a_rival_and_crowds():
    odds = lines_log_odds(8, 0.2, 0.5, 4000)
    assert odds > lines_log_odds(5, 0.2, 0.5, 4000)
    assert odds > lines_log_odds(8, 0.3, 0.5, 4000)
    assert odds > lines_log_odds(8, 0.2, 0.9, 4000)
    assert odds > lines_log_odds(8, 0.2, 0.5, 6400)
    assert np.isfinite(lines_log_odds(0, np.inf, 1.0, 0))


def test_lines_of_two_places_get_no_pose(rng):
    """Twenty draws of two unrelated places: no answer, so never an identity either."""
    for _ in range(20):
        result = register_lines(
            poles(rng.uniform(-40, 40, (15, 2))), poles(rng.uniform(-40, 40, (15, 2)))
        )
        assert not result.success
        assert result.T_target_source is None
        assert result.reason


def test_rotations_are_proper_for_any_yaw(rng):
    for yaw_deg in (0.0, 90.0, 180.0, -123.0):
        T_true = from_yaw(np.radians(yaw_deg), np.array([3.0, 14.0, 0.0]))
        target = poles(rng.uniform(-35, 35, (12, 2)))
        result = register_lines(target.transformed(invert(T_true)), target)
        assert result.success
        assert np.linalg.det(result.T_target_source[:3, :3]) == pytest.approx(1.0, abs=1e-12)
        assert error(T_true, result.T_target_source)[0] < 1e-3


@pytest.mark.parametrize("count", [0, 1, 2, 3])
def test_few_lines_are_a_no_with_a_reason(rng, count):
    few = poles(rng.uniform(-20, 20, (count, 2)))
    result = register_lines(few, few)
    assert not result.success
    assert result.T_target_source is None
    assert result.reason
    assert not result.information.any()


def test_clouds_of_another_form_are_named(rng):
    lines = poles(rng.uniform(-20, 20, (5, 2)))
    cloud = rng.uniform(-9, 9, (200, 3))
    with pytest.raises(InputError, match=r"target has shape \(200, 4\)"):
        register_lines(lines, lines, (cloud, np.zeros((200, 4))))
    cloud[3, 1] = np.nan
    with pytest.raises(InputError, match="source holds NaN"):
        register_lines(lines, lines, (cloud, cloud))


def test_tiny_clouds_are_a_no_with_a_reason(rng):
    lines = poles(rng.uniform(-20, 20, (9, 2)))
    tiny = rng.uniform(-9, 9, (20, 3))
    result = register_lines(lines, lines, (tiny, tiny))
    assert not result.success
    assert "too few points" in result.reason


def test_what_has_lines_most_alike_is_tried_where_fields_like_another_place(
    ring_drive, monkeypatch
):
    scans = [scan.points_lidar for scan in simulate_drive(ring_drive, [8, 4])]
    views = [make_view(scan, *extract(scan), MatchingSettings().cloud_voxel_m) for scan in scans]
    sides = [PreparedView(view, MatchingSettings()) for view in views]
    elsewhere = np.array([[1.0, 30.0, -20.0]]), np.array([1.0])
    monkeypatch.setattr(registration, "by_fields", lambda *_: elsewhere)
    result = register_views(*sides, MatchingSettings())
    assert result.success, result.reason
    T_truth = invert(ring_drive.T_town_lidar[4]) @ ring_drive.T_town_lidar[8]
    error_m, error_deg = error(T_truth, result.T_target_source)
    assert error_m < 0.2
    assert error_deg < 0.5


def test_distinct_poses_differ_in_place_or_heading():
    poses = np.array([[0, 0, 0], [0.05, 1.0, 0], [3.13, 0, 0], [-3.13, 0, 0], [0, 2.1, 0.0]])
    assert distinct(poses, 9).tolist() == [0, 2, 4]
    assert distinct(poses, 2).tolist() == [0, 2]
    assert distinct(np.zeros((0, 3)), 2).tolist() == []


@pytest.fixture(scope="module")
def street(real_scans, shared):
    """Scans 0 and 10 of drive 01, 13 m apart, and ``T_0_10``."""
    rows = np.loadtxt(shared / "data" / "01.poses.txt").reshape(-1, 3, 4)
    T_world_lidar = np.tile(np.eye(4), (len(rows), 1, 1))
    T_world_lidar[:, :3] = rows
    target, source = real_scans("01", [0, 10])
    return target, source, invert(T_world_lidar[0]) @ T_world_lidar[10]


@pytest.fixture(scope="module")
def turned(street):
    """The same with the source sensor turned by 137 degrees."""
    target, source, T_target_source = street
    T_turned_lidar = from_yaw(np.radians(137.0), np.zeros(3))
    return (
        target,
        transform_points(T_turned_lidar, source),
        T_target_source @ invert(T_turned_lidar),
    )


def extract(*clouds):
    return [LineExtractor().extract(cloud) for cloud in clouds]


@pytest.mark.data
def test_two_real_scans_13_m_apart_and_turned_by_137_degrees(turned):
    target, source, T_truth = turned
    assert 10.0 < distance_m(T_truth) < 15.0
    result = register_lines(*extract(source, target), (source, target))
    assert result.success, result.reason
    error_m, error_deg = error(T_truth, result.T_target_source)
    assert error_m < 0.3  # the truth itself is good to decimetres
    assert error_deg < 1.5
    assert np.linalg.matrix_rank(result.information) == 6


@pytest.mark.data
def test_real_lines_alone(turned):
    target, source, T_truth = turned
    result = register_lines(*extract(source, target))
    assert result.success, result.reason
    error_m, error_deg = error(T_truth, result.T_target_source)
    assert error_m < 1.0  # height and tilt come from the lines' own up direction
    assert error_deg < 3.0


@pytest.mark.data
def test_a_real_scan_tilted_by_10_degrees(turned):
    target, source, T_truth = turned
    roll = Rotation.from_euler("x", 10, degrees=True).as_matrix()
    T_tilted_lidar = make_transform(roll, np.zeros(3))
    tilted = transform_points(T_tilted_lidar, source)
    result = register_lines(*extract(tilted, target), (tilted, target))
    assert result.success, result.reason
    error_m, error_deg = error(T_truth @ invert(T_tilted_lidar), result.T_target_source)
    assert error_m < 0.3
    assert error_deg < 1.5


@pytest.mark.data
@pytest.mark.parametrize("pair", [(0, 5), (10, 30)])
def test_scans_of_two_real_streets_are_refused(real_scans, pair):
    (first,), (second,) = real_scans("01", [pair[0]]), real_scans("02", [pair[1]])
    lines = extract(first, second)
    for clouds in ((first, second), None):
        result = register_lines(*lines, clouds, MatchingSettings())
        assert not result.success
        assert result.T_target_source is None
        assert result.reason

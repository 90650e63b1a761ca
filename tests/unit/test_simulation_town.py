"""Towns and drives: what must be true whatever the seed."""

import json

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from sl3d_slam.cli.simulate import simulate
from sl3d_slam.errors import InputError, OutputError
from sl3d_slam.geometry.se3 import transform_points
from sl3d_slam.simulation.drive import TURN_SCANS, drive_path, plan_drive, simulate_drive
from sl3d_slam.simulation.ground import SENSOR_HEIGHT_M
from sl3d_slam.simulation.primitives import PATCH, Semantic, bounds
from sl3d_slam.simulation.roads import ROAD_NAMES, TR_CAMERA_LIDAR, builtin_road, read_road
from sl3d_slam.simulation.town import build_town
from sl3d_slam.simulation.write import Layout, write_drive
from sl3d_slam.types import LineKind

SEED = 3


@pytest.fixture(scope="module")
def town():
    return build_town(builtin_road("demo"), SEED)


@pytest.fixture(scope="module")
def first_scans(town):
    drive = plan_drive(town, scans=3)
    return drive, list(simulate_drive(drive))


def run(*arguments):
    app = typer.Typer(pretty_exceptions_enable=False)
    app.command()(simulate)
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def test_nothing_stands_on_a_road(town):
    box = bounds(town.primitives)
    middle = 0.5 * (box[:, :2] + box[:, 3:5])
    low = box[:, 2] < town.ground.height_m(middle) + 2.2  # what a car would drive into
    # walls and hedges stand askew in their bounds, so points on them are looked at, not the bounds
    p, walls = town.primitives.parameters[low], town.primitives.kinds[low] == PATCH
    share = np.linspace(0.0, 1.0, 40)[:, None, None]
    along = (p[walls, :2] + share * p[walls, 3:5] * p[walls, 12:13]).reshape(-1, 2)
    assert town.ground.road_distance_m(along).min() > 0.0
    assert town.ground.road_distance_m(middle[low]).min() > 0.0


def test_roads_are_free_of_returns_from_anything_that_stands_still(town, first_scans):
    drive, scans = first_scans
    still = [Semantic.BUILDING, Semantic.POLE, Semantic.TRUNK, Semantic.FENCE, Semantic.VEGETATION]
    for T_town_lidar, scan in zip(drive.T_town_lidar, scans, strict=True):
        points = transform_points(T_town_lidar, scan.points_lidar)
        low = points[:, 2] < town.ground.height_m(points[:, :2]) + 2.0
        suspects = points[np.isin(scan.labels, still) & low, :2]
        assert len(suspects) > 1000
        # 0.1 m: five sigmas of range noise
        assert town.ground.road_distance_m(suspects).min() > -0.1


def test_points_of_a_true_line_lie_on_it(town, first_scans):
    drive, scans = first_scans
    radius = {LineKind.POLE: 0.36, LineKind.VERTICAL_EDGE: 0.15, LineKind.OTHER_EDGE: 0.15}
    seen = set()
    for T_town_lidar, scan in zip(drive.T_town_lidar, scans, strict=True):
        on = scan.line_ids >= 0
        points = transform_points(T_town_lidar, scan.points_lidar[on])
        ends = town.lines.endpoints[scan.line_ids[on]]
        length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
        unit = (ends[:, 1] - ends[:, 0]) / length[:, None]
        along = np.sum((points - ends[:, 0]) * unit, axis=1)
        aside = np.linalg.norm(np.cross(points - ends[:, 0], unit), axis=1)
        for kind, limit in radius.items():
            chosen = town.lines.kinds[scan.line_ids[on]] == kind
            # 0.1 m: five sigmas of range noise, along the ray
            assert aside[chosen].max(initial=0.0) < limit + 0.1
        assert along.min() > -0.75  # the foot of a wall is the lowest ground under its house
        assert (along - length).max() < 0.1
        seen |= set(scan.line_ids[on])
    assert len(seen) > 30


def test_the_same_seed_gives_the_same_bytes_and_another_seed_another_town(town, first_scans):
    again = build_town(builtin_road("demo"), SEED)
    scan = next(simulate_drive(plan_drive(again, scans=1)))
    np.testing.assert_array_equal(scan.points_lidar, first_scans[1][0].points_lidar)
    np.testing.assert_array_equal(scan.line_ids, first_scans[1][0].line_ids)
    other = build_town(builtin_road("demo"), SEED + 1)
    assert other.lines.endpoints.shape != town.lines.endpoints.shape


def test_another_day_moves_the_cars_but_not_the_town(town):
    monday, tuesday = plan_drive(town, day=0), plan_drive(town, day=1)
    assert tuesday.town is town
    assert len(monday.traffic.parked) != len(tuesday.traffic.parked)
    aside = np.linalg.norm(monday.T_town_lidar[:, :2, 3] - tuesday.T_town_lidar[:, :2, 3], axis=1)
    assert 0.05 < np.median(aside) < 1.0  # another place in the lane


def test_day_0_starts_at_the_origin_of_the_world(town):
    np.testing.assert_allclose(plan_drive(town).T_town_lidar[0], np.eye(4), atol=1e-6)


@pytest.mark.parametrize("direction", ["forward", "reverse", "half"])
def test_the_car_stands_on_the_road(town, direction):
    poses = plan_drive(town, day=2, direction=direction).T_town_lidar
    under = poses[:, :2, 3]
    assert town.ground.road_distance_m(under).max() < -1.0
    height = poses[:, 2, 3] - town.ground.height_m(under)
    # springs 12 mm, and the ground bends between the wheels
    np.testing.assert_allclose(height, SENSOR_HEIGHT_M, atol=0.06)
    np.testing.assert_allclose(np.linalg.det(poses[:, :3, :3]), 1.0, atol=1e-9)


def test_reverse_drives_the_same_road_the_other_way(town):
    forward, reverse = plan_drive(town), plan_drive(town, direction="reverse")
    assert len(forward) == len(reverse)
    gap = forward.T_town_lidar[:, :2, 3] - reverse.T_town_lidar[::-1, :2, 3]
    np.testing.assert_allclose(np.linalg.norm(gap, axis=1), 0.9, atol=0.01)
    facing = np.sum(forward.T_town_lidar[:, :2, 0] * reverse.T_town_lidar[::-1, :2, 0], axis=1)
    assert facing.max() < -0.99


def test_a_u_turn_is_gradual_and_comes_back_in_the_other_lane():
    road = builtin_road("outback")
    path = drive_path(road.path, road.returns, 0, "forward")
    steps = np.linalg.norm(np.diff(path[:, :2], axis=0), axis=1)
    assert steps.max() < 1.3
    turns = np.degrees(np.diff(path[:, 2]))
    assert np.abs(turns).max() < 1.5 * 180.0 / TURN_SCANS + 0.5
    assert np.abs(np.diff(turns)).max() < 2.0  # constant velocity stays a fair guess
    assert np.abs(np.diff(steps)).max() < 0.15
    out, back = path[50], path[-51]
    assert np.cos(out[2] - back[2]) < -0.999
    assert 3.0 < np.linalg.norm(out[:2] - back[:2]) < 4.2


@pytest.mark.parametrize(("name", "overlap_m"), [("loop", 60.0), ("demo", 30.0)])
def test_loops_come_back_over_their_start(name, overlap_m):
    xy = builtin_road(name).path[:, :2]
    away = np.linalg.norm(xy[:, None] - xy[None, :], axis=2)
    index = np.arange(len(xy))
    revisits = (away < 1.0) & (index[:, None] - index[None, :] > 100)
    step = np.linalg.norm(np.diff(xy, axis=0), axis=1).mean()
    assert revisits.any(axis=1).sum() * step >= overlap_m


def test_every_built_in_road_moves_by_car_like_steps():
    for name in ROAD_NAMES:
        path = builtin_road(name).path
        steps = np.linalg.norm(np.diff(path[:, :2], axis=0), axis=1)
        assert 0.3 < steps.min() < steps.max() < 1.3
        np.testing.assert_array_equal(path[0], 0.0)


def test_a_trajectory_of_a_camera_becomes_the_way_of_the_lidar(tmp_path):
    # the camera drives 40 m along its z, then 40 m along its x (to the right)
    rows = [[1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, z] for z in range(41)]
    rows += [[0, 0, 1, x, 0, 1, 0, 0, -1, 0, 0, 40] for x in range(1, 41)]
    np.savetxt(tmp_path / "07.txt", rows)
    path = read_road(tmp_path / "07.txt").path
    # the calibration turns the axes by half a degree: 0.5 m over 57 m
    np.testing.assert_allclose(path[40, :2], [40.0, 0.0], atol=0.6)
    np.testing.assert_allclose(path[-1, :2], [40.0, -40.0], atol=1.0)
    assert path[-1, 3] == pytest.approx(-np.pi / 2, abs=0.02)


@pytest.mark.parametrize("text", ["", "1 2 3\n", "no numbers\n", "1 0 0 0 0 1 0 0 0 0 1 nan\n"])
def test_a_file_that_is_no_trajectory_is_named(tmp_path, text):
    path = tmp_path / "bad.txt"
    path.write_text(text)
    with pytest.raises(InputError, match=r"bad\.txt"):
        read_road(path)


def test_the_folder_reads_as_kitti_odometry(town, first_scans, tmp_path):
    drive, scans = first_scans
    folder = write_drive(drive, Layout(tmp_path, "04"))
    assert folder == tmp_path / "sequences" / "04"
    raw = np.fromfile(folder / "velodyne" / "000001.bin", "<f4").reshape(-1, 4)
    np.testing.assert_allclose(raw[:, :3], scans[1].points_lidar, atol=1e-5)
    assert 0.0 <= raw[:, 3].min() < raw[:, 3].max() < 1.0
    poses = np.loadtxt(tmp_path / "poses" / "04.txt").reshape(-1, 3, 4)
    T_camera0_camera = np.tile(np.eye(4), (3, 1, 1))
    T_camera0_camera[:, :3] = poses
    T_world_lidar = np.linalg.inv(TR_CAMERA_LIDAR) @ T_camera0_camera @ TR_CAMERA_LIDAR
    np.testing.assert_allclose(T_world_lidar, drive.T_town_lidar, atol=1e-6)
    np.testing.assert_allclose(poses[0], np.eye(4)[:3], atol=1e-6)
    calibration = dict(line.split(":") for line in (folder / "calib.txt").read_text().splitlines())
    np.testing.assert_allclose(
        np.array(calibration["Tr"].split(), float).reshape(3, 4), TR_CAMERA_LIDAR[:3]
    )
    assert len((folder / "times.txt").read_text().split()) == 3
    about = json.loads((folder / "simulation.json").read_text())
    assert about["simulated"] is True
    assert (about["seed"], about["day"], about["sensor"]) == (SEED, 0, "hdl64")


def test_truth_is_beside_the_scans(town, first_scans, tmp_path):
    drive, scans = first_scans
    folder = write_drive(drive, Layout(tmp_path))
    with np.load(folder / "lines.npz", allow_pickle=False) as lines:
        np.testing.assert_array_equal(lines["endpoints"], town.lines.endpoints)
        assert set(lines["kinds"]) == {LineKind.POLE, LineKind.VERTICAL_EDGE, LineKind.OTHER_EDGE}
    with np.load(folder / "labels" / "000002.npz", allow_pickle=False) as labels:
        np.testing.assert_array_equal(labels["line_id"], scans[2].line_ids)
        np.testing.assert_array_equal(labels["semantic"], scans[2].labels)


def test_a_sequence_that_is_there_is_never_overwritten(first_scans, tmp_path):
    folder = tmp_path / "sequences" / "00"
    folder.mkdir(parents=True)
    (folder / "mine.txt").write_text("precious")
    with pytest.raises(OutputError, match="already there"):
        write_drive(first_scans[0], Layout(tmp_path))
    assert (folder / "mine.txt").read_text() == "precious"
    with pytest.raises(OutputError, match="letters and digits"):
        write_drive(first_scans[0], Layout(tmp_path, "../00"))


def test_the_verb_writes_a_sequence_and_refuses_nonsense(tmp_path):
    assert (
        run(tmp_path, "--road", "demo", "--scans", 2, "--sensor", "hdl32", "--quiet").exit_code == 0
    )
    scans = sorted((tmp_path / "sequences" / "00" / "velodyne").iterdir())
    assert [scan.name for scan in scans] == ["000000.bin", "000001.bin"]
    for arguments in (("--road", "nowhere"), ("--sensor", "sonar"), ("--direction", "up")):
        result = run(tmp_path, "--sequence", "01", *arguments)
        assert isinstance(result.exception, InputError)
        assert arguments[1] in str(result.exception)
    assert not (tmp_path / "sequences" / "01").exists()

"""Scans of the mapped drive, turned and unseen by any keyframe, and a scan of another town."""

import json

import numpy as np
import pytest

from sl3d_slam import LineMap, Relocalizer
from sl3d_slam.geometry.se3 import (
    distance_m,
    from_yaw,
    invert,
    rotation_angle_rad,
    transform_points,
)

# odd scans: with 2 m steps every second scan is a keyframe
TURNED = [(7, 137), (15, -90), (25, 180), (35, 45), (47, -20)]


def write_bin(path, points):
    np.c_[points, np.zeros(len(points))].astype("<f4").tofile(path)
    return path


def turned_scan(dataset, index, yaw_deg):
    """A scan with the sensor turned, and its true pose in the map (the first scan's frame)."""
    T_turned_lidar = from_yaw(np.radians(yaw_deg), np.zeros(3))
    (scan,) = dataset.iterate(index, index + 1)
    T_map_turned = invert(dataset.truth[0]) @ dataset.truth[index] @ invert(T_turned_lidar)
    return transform_points(T_turned_lidar, scan.points_lidar), T_map_turned


@pytest.fixture(scope="module")
def elsewhere():
    """A scan of another town's street, by the same sensor."""
    from sl3d_slam.simulation.drive import plan_drive, simulate_drive
    from sl3d_slam.simulation.roads import builtin_road
    from sl3d_slam.simulation.town import build_town

    drive = plan_drive(build_town(builtin_road("street"), seed=91), "hdl32")
    return next(simulate_drive(drive, [60])).points_lidar


@pytest.fixture(scope="module")
def relocalizer(ring_run):
    return Relocalizer(LineMap.load(ring_run / "map.sl3d"))


@pytest.mark.parametrize(("index", "yaw_deg"), TURNED)
def test_a_turned_scan_is_found_where_it_is(relocalizer, ring_dataset, index, yaw_deg):
    points, T_truth = turned_scan(ring_dataset, index, yaw_deg)
    answer = relocalizer.relocalize(points)
    assert answer.success, answer.reason
    T_error = invert(T_truth) @ answer.T_map_lidar
    assert distance_m(T_error) < 0.5
    assert rotation_angle_rad(T_error) < np.radians(2.0)
    assert 0.0 < answer.confidence <= 1.0
    assert np.linalg.matrix_rank(answer.information) == 6


def test_a_scan_of_another_town_is_not_found(relocalizer, elsewhere):
    answer = relocalizer.relocalize(elsewhere)
    assert not answer.success
    assert answer.T_map_lidar is None
    assert answer.confidence == 0.0
    assert answer.reason


def test_the_same_scan_gets_the_same_answer_whatever_was_asked_before(
    relocalizer, ring_run, ring_dataset
):
    points, _ = turned_scan(ring_dataset, 25, 60.0)
    fresh = Relocalizer(LineMap.load(ring_run / "map.sl3d")).relocalize(points)
    np.testing.assert_array_equal(relocalizer.relocalize(points).T_map_lidar, fresh.T_map_lidar)


def test_the_command_line_answers_for_each_scan(sl3d, ring_run, ring_dataset, elsewhere, tmp_path):
    points, T_truth = turned_scan(ring_dataset, 35, 100.0)
    known = write_bin(tmp_path / "known.bin", points)
    strange = write_bin(tmp_path / "strange.bin", elsewhere)
    result = sl3d("relocalize", ring_run / "map.sl3d", known, strange, "--json")
    assert result.returncode == 1  # done, but one answer is no
    here, nowhere = json.loads(result.stdout)
    assert here["scan"] == str(known)
    assert here["success"] is True
    assert distance_m(invert(T_truth) @ np.array(here["T_map_lidar"])) < 0.5
    assert (nowhere["success"], nowhere["T_map_lidar"]) == (False, None)
    assert nowhere["reason"]


def test_one_found_scan_is_status_0_and_a_sentence(sl3d, ring_run, ring_dataset, tmp_path):
    points, _ = turned_scan(ring_dataset, 15, 0.0)
    result = sl3d("relocalize", ring_run / "map.sl3d", write_bin(tmp_path / "a.bin", points))
    assert result.returncode == 0, result.stderr
    assert "confidence" in result.stdout


def test_only_a_scan_that_is_found_is_drawn(sl3d, ring_run, ring_dataset, elsewhere, tmp_path):
    points, _ = turned_scan(ring_dataset, 15, 80.0)
    known, strange = (tmp_path / name for name in ("known.png", "strange.png"))
    line_map = ring_run / "map.sl3d"
    asked = write_bin(tmp_path / "a.bin", points), write_bin(tmp_path / "b.bin", elsewhere)
    assert sl3d("relocalize", line_map, *asked, "--out", known).returncode == 1
    assert known.read_bytes().startswith(b"\x89PNG")
    assert sl3d("relocalize", line_map, asked[1], "--out", strange).returncode == 1
    assert not strange.exists()
    wrong = sl3d("relocalize", line_map, asked[0], "--out", tmp_path / "a.svg")
    assert (wrong.returncode, ".png" in wrong.stderr) == (2, True)


def test_two_scans_are_registered_from_the_command_line(sl3d, ring_dataset, tmp_path):
    (target,) = ring_dataset.iterate(10, 11)
    points, T_map_turned = turned_scan(ring_dataset, 12, 120.0)
    files = [
        write_bin(tmp_path / "source.bin", points),
        write_bin(tmp_path / "target.bin", target.points_lidar),
    ]
    result = sl3d("register", *files, "--json", "--out", tmp_path / "pair.png")
    assert result.returncode == 0, result.stdout + result.stderr
    answer = json.loads(result.stdout)
    T_map_target = invert(ring_dataset.truth[0]) @ ring_dataset.truth[10]
    T_truth = invert(T_map_target) @ T_map_turned
    assert distance_m(invert(T_truth) @ np.array(answer["T_target_source"])) < 0.3
    assert len(answer["matches"]) == answer["num_inliers"]
    assert (tmp_path / "pair.png").read_bytes().startswith(b"\x89PNG")


def test_a_pair_that_has_no_answer_is_status_1(sl3d, ring_dataset, elsewhere, tmp_path):
    (target,) = ring_dataset.iterate(10, 11)
    files = [
        write_bin(tmp_path / "source.bin", elsewhere),
        write_bin(tmp_path / "target.bin", target.points_lidar),
    ]
    result = sl3d("register", *files)
    assert result.returncode == 1
    assert result.stdout.startswith("no answer: ")
    silent = sl3d("register", *files, "--quiet")
    assert (silent.returncode, silent.stdout, silent.stderr) == (1, "", "")

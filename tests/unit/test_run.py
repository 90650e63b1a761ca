"""What the pipeline takes and what a run leaves, without a drive."""

import json

import numpy as np
import pytest

from sl3d_slam import SlamPipeline, load_config
from sl3d_slam.errors import InputError, OutputError
from sl3d_slam.run import StageTimes

FEW = ["loops.enabled=false"]


@pytest.fixture
def points(rng):
    ground = np.c_[rng.uniform(-30, 30, (3000, 2)), np.full(3000, -1.7)]
    poles = [
        np.c_[xy + rng.normal(0, 0.01, (120, 2)), rng.uniform(-1.7, 3.0, 120)]
        for xy in rng.uniform(-20, 20, (8, 2))
    ]
    return np.concatenate([ground, *poles])


@pytest.fixture
def slam():
    return SlamPipeline(load_config(None, FEW))


def test_stage_times_are_in_milliseconds():
    times = StageTimes()
    for seconds in (0.1, 0.2, 0.3):
        times.add("lines", seconds)
    summary = times.summary()["lines"]
    assert summary["mean_ms"] == pytest.approx(200.0)
    assert summary["p99_ms"] == pytest.approx(298.0)
    assert summary["calls"] == 3


def test_nothing_in_is_nothing_to_map(slam):
    with pytest.raises(InputError, match="no scan"):
        slam.finish()


@pytest.mark.parametrize(
    "scan", [np.zeros((500, 4)), np.zeros(500), np.full((500, 3), np.nan), np.zeros((0, 3))]
)
def test_what_is_no_scan_is_named_by_its_number_and_changes_nothing(slam, points, scan):
    slam.process_scan(points)
    with pytest.raises(InputError, match="scan 1"):
        slam.process_scan(scan)
    slam.process_scan(points)
    assert len(slam.finish().trajectory) == 2


@pytest.mark.parametrize("stamps", [np.zeros(10), np.zeros((3960, 1)), np.full(3960, np.nan)])
def test_a_time_for_each_point_or_none_at_all(slam, points, stamps):
    assert len(points) == 3960
    with pytest.raises(InputError, match=r"scan 0: stamps .* a finite time in seconds"):
        slam.process_scan(points, stamps=stamps)
    assert len(slam.process_scan(points, stamps=np.zeros(3960)).points_lidar) > 3000


def test_one_scan_is_a_run_with_one_pose_and_no_loop(slam, points, tmp_path):
    slam.process_scan(points, stamp_s=12.5)
    run = slam.finish()
    np.testing.assert_allclose(run.trajectory.T_world_lidar, [np.eye(4)], atol=1e-9)
    assert run.trajectory.stamps_s.tolist() == [12.5]
    figures = run.save(tmp_path / "run")
    assert figures["loops_accepted"] == 0
    assert "ate_rmse_m" not in figures  # no truth, no figure that would need it
    assert figures["simulated"] is False
    assert not (tmp_path / "run" / "poses_kitti.txt").exists()  # no calibration
    assert json.loads((tmp_path / "run" / "loops.json").read_text()) == []


def test_scans_without_times_are_a_tenth_of_a_second_apart(slam, points):
    for _ in range(3):
        slam.process_scan(points)
    np.testing.assert_allclose(slam.finish().trajectory.stamps_s, [0.0, 0.1, 0.2])


def test_points_that_are_not_finite_are_left_out(points):
    runs = []
    holes = np.concatenate([points, np.full((50, 3), np.nan)])
    for scan in (points, holes):
        slam = SlamPipeline(load_config(None, FEW))
        slam.process_scan(scan)
        runs.append(slam.finish())
    assert len(runs[0].line_map) == len(runs[1].line_map) > 0
    assert runs[0].graph_g2o == runs[1].graph_g2o


def test_a_folder_that_cannot_be_is_named(slam, points, tmp_path):
    slam.process_scan(points)
    taken = tmp_path / "taken"
    taken.write_text("a file")
    with pytest.raises(OutputError, match="taken"):
        slam.finish().save(taken)
    assert taken.read_text() == "a file"

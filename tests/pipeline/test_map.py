"""``sl3d map`` on a short simulated drive that closes a loop: every file it leaves."""

import json

import numpy as np
import pytest
import yaml

from sl3d_slam import LineMap, load_config
from sl3d_slam.geometry.se3 import distance_m, exp, invert, rotation_angle_rad
from sl3d_slam.graph.g2o import read_g2o
from sl3d_slam.graph.solve import anchor, optimise
from sl3d_slam.io.trajectory import read_kitti_poses, read_tum, to_lidar_frame
from sl3d_slam.report.metrics import ate_rmse_m

FILES = {
    "poses_tum.txt",
    "poses_kitti.txt",
    "odometry_tum.txt",
    "loops.json",
    "graph.g2o",
    "map.sl3d",
    "metrics.json",
    "config.yaml",
    "run.json",
    "trajectory.png",
    "map.png",
}
PNG = b"\x89PNG\r\n\x1a\n"


@pytest.fixture(scope="module")
def metrics(ring_run):
    return json.loads((ring_run / "metrics.json").read_text())


@pytest.fixture(scope="module")
def loops(ring_run):
    return json.loads((ring_run / "loops.json").read_text())


def test_every_file_is_there_and_no_other(ring_run):
    assert {path.name for path in ring_run.iterdir()} == FILES


def test_poses_are_right_and_no_worse_than_odometry(ring_run, ring_dataset, metrics):
    poses, odometry = (read_tum(ring_run / f"{n}_tum.txt") for n in ("poses", "odometry"))
    truth = ring_dataset.truth
    assert len(poses) == len(odometry) == len(truth) == 59
    ate = ate_rmse_m(poses.T_world_lidar, truth)
    assert ate < 0.15  # voxels of a metre on 59 scans
    assert ate < ate_rmse_m(odometry.T_world_lidar, truth) + 0.01
    assert metrics["ate_rmse_m"] == pytest.approx(ate, abs=1e-6)
    np.testing.assert_allclose(np.diff(poses.stamps_s), 0.1, atol=1e-6)


def test_kitti_poses_are_the_same_in_the_camera_frame(ring_run, ring_dataset):
    camera = read_kitti_poses(ring_run / "poses_kitti.txt")
    lidar = to_lidar_frame(camera, ring_dataset.T_cam_lidar)
    poses = read_tum(ring_run / "poses_tum.txt").T_world_lidar
    np.testing.assert_allclose(lidar, invert(poses[0]) @ poses, atol=1e-5)


def test_loops_are_found_and_true(loops, metrics, ring_dataset):
    accepted = [loop for loop in loops if loop["status"] == "accepted"]
    assert len(accepted) >= 5
    assert metrics["loops_accepted"] == len(accepted)
    assert metrics["loops_false"] == 0
    revisits = [loop for loop in accepted if loop["query_scan"] >= 44]
    assert len(revisits) >= 3
    truth = ring_dataset.truth
    for loop in accepted:
        T_truth = invert(truth[loop["target_scan"]]) @ truth[loop["query_scan"]]
        T_error = invert(T_truth) @ np.array(loop["T_target_query"])
        assert distance_m(T_error) < 0.3
        assert rotation_angle_rad(T_error) < np.radians(2.0)


def test_each_loop_record_is_complete(loops):
    for loop in loops:
        assert set(loop) == {
            "query_scan",
            "target_scan",
            "T_target_query",
            "num_inliers",
            "status",
            "reason",
        }
        assert 0 <= loop["target_scan"] < loop["query_scan"] < 59
        assert np.array(loop["T_target_query"]).shape == (4, 4)
        assert loop["status"] in {"accepted", "rejected", "revoked"}
        assert (loop["reason"] == "") == (loop["status"] == "accepted")
    order = [(loop["query_scan"], loop["target_scan"]) for loop in loops]
    assert order == sorted(order)


def test_the_graph_reopens_to_the_same_solution(ring_run, loops, rng):
    graph = read_g2o(ring_run / "graph.g2o")
    poses = read_tum(ring_run / "poses_tum.txt").T_world_lidar
    assert sorted(graph.poses) == list(range(59))
    stored = np.array([graph.poses[key] for key in range(59)])
    np.testing.assert_allclose(stored, poses, atol=1e-6)
    jumps = [edge for edge in graph.edges if edge.second - edge.first != 1]
    accepted = [loop for loop in loops if loop["status"] == "accepted"]
    assert len(jumps) == len(accepted)

    disturbed = {
        key: pose @ exp(np.repeat([0.01, 0.2], 3) * rng.uniform(-1, 1, 6))
        for key, pose in graph.poses.items()
    }
    _, solution = optimise(disturbed, graph.edges, [anchor(0, graph.poses[0])])
    for key in range(59):
        T_error = invert(graph.poses[key]) @ solution.atPose3(key).matrix()
        assert distance_m(T_error) < 1e-3


def test_the_map_opens_and_lies_where_the_town_stands(ring_run, ring_dataset):
    line_map = LineMap.load(ring_run / "map.sl3d")
    assert line_map.simulated
    assert len(line_map) > 20
    assert line_map.cloud is not None
    truth = ring_dataset.truth[:, :3, 3]
    middles = line_map.lines.endpoints.mean(axis=1)
    gaps = np.linalg.norm(middles[:, None, :2] - truth[None, :, :2], axis=2).min(axis=1)
    assert gaps.max() < 60.0


def test_figures_are_complete_and_labelled_as_simulated(metrics):
    for key in (
        "ate_rmse_m",
        "odometry_ate_rmse_m",
        "kitti_translation_percent",
        "kitti_rotation_deg_per_m",
        "loops_accepted",
        "loops_false",
        "peak_rss_mb",
        "map_kb_per_km",
    ):
        assert key in metrics
    assert metrics["simulated"] is True
    assert metrics["num_scans"] == 59
    assert metrics["stages"]["odometry"]["calls"] == 59
    assert metrics["stages"]["lines"]["calls"] == metrics["num_keyframes"]
    for stage in metrics["stages"].values():
        assert stage["mean_ms"] > 0
        assert stage["p99_ms"] > 0


def test_settings_and_provenance_are_kept(ring_run, ring_folder):
    assert load_config(ring_run / "config.yaml") == load_config()
    assert yaml.safe_load((ring_run / "config.yaml").read_text())["seed"] == 0
    facts = json.loads((ring_run / "run.json").read_text())
    assert facts["simulated"] is True
    assert facts["seed"] == 0
    assert str(ring_folder) in facts["input"]
    assert {"numpy", "gtsam", "kiss-icp"} <= set(facts["packages"])


@pytest.mark.parametrize("name", ["trajectory.png", "map.png"])
def test_pictures_are_pictures(ring_run, name):
    raw = (ring_run / name).read_bytes()
    assert raw.startswith(PNG)
    assert len(raw) > 5000

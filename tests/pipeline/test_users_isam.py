"""The plugin's promise: a user's own iSAM2 on the town of KITTI 07, fed by the plugin alone."""

from itertools import pairwise

import gtsam
import numpy as np
import pytest

from sl3d_slam.config import load_config
from sl3d_slam.frontend import LineLoopFrontend
from sl3d_slam.geometry.se3 import distance_m, exp, invert
from sl3d_slam.report.metrics import ate_rmse_m
from sl3d_slam.simulation.drive import plan_drive, simulate_drive
from sl3d_slam.simulation.roads import read_road
from sl3d_slam.simulation.town import build_town

pytestmark = pytest.mark.slow

STRIDE = 3
ROTATION_DEG, TRANSLATION_M = 0.2, 0.05  # white noise of each step of some 2 m


def test_a_quarter_of_noisy_odometry_is_left_at_most(shared):
    road = read_road(shared / "benchmarks" / "kitti_gt_poses" / "07.txt")
    planned = plan_drive(build_town(road, seed=7), sensor="hdl32")
    indices = range(0, len(planned), STRIDE)
    truth = planned.T_town_lidar[:: indices.step]
    odometry = noisy(truth, np.random.default_rng(1))
    settings = (
        f"graph.odometry_rotation_sigma_deg={ROTATION_DEG}",
        f"graph.odometry_translation_sigma_m={TRANSLATION_M}",
    )
    isam = gtsam.ISAM2()
    frontend = LineLoopFrontend(
        load_config(overrides=settings), graph=isam.getFactorsUnsafe, odometry_factors=True
    )
    held = gtsam.noiseModel.Isotropic.Sigma(6, 1e-3)
    for key, scan in enumerate(simulate_drive(planned, indices)):
        update = frontend.add_keyframe(key, scan.points_lidar, odometry[key])
        if key == 0:
            update.factors.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(odometry[0]), held))
        isam.update(update.factors, update.initial, update.revoked)
        frontend.update_estimates(isam.calculateEstimate())
    update = frontend.settle()
    isam.update(update.factors, update.initial, update.revoked)
    for _ in range(3):
        isam.update()
    solved = np.array([isam.calculateEstimatePose3(key).matrix() for key in range(len(truth))])
    loops = [verdict.loop for verdict in frontend.verdicts if verdict.status == "accepted"]
    assert len(loops) > 30
    for loop in loops:
        T_target_query = invert(truth[loop.target_id]) @ truth[loop.query_id]
        assert distance_m(invert(T_target_query) @ loop.T_target_query) < 1.0
    assert ate_rmse_m(solved, truth) < 0.25 * ate_rmse_m(odometry, truth)


def noisy(truth, rng):
    sigmas = np.repeat([np.radians(ROTATION_DEG), TRANSLATION_M], 3)
    poses = [truth[0]]
    for before, after in pairwise(truth):
        step = exp(np.r_[rng.normal(0, sigmas[:3], 3), rng.normal(0, sigmas[3:], 3)])
        poses.append(poses[-1] @ invert(before) @ after @ step)
    return np.array(poses)

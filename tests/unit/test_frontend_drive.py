"""The plugin on a simulated drive: with a user's own iSAM2, and against the pipeline."""

from dataclasses import dataclass
from itertools import pairwise

import gtsam
import numpy as np
import pytest

from sl3d_slam.config import load_config
from sl3d_slam.frontend import LineLoopFrontend
from sl3d_slam.geometry.se3 import distance_m, exp, invert
from sl3d_slam.keyframes import KeyframeSelector
from sl3d_slam.pipeline import SlamPipeline
from sl3d_slam.report.metrics import ate_rmse_m
from sl3d_slam.run import Run
from sl3d_slam.simulation.drive import plan_drive, simulate_drive
from sl3d_slam.simulation.roads import builtin_road
from sl3d_slam.simulation.town import build_town

pytestmark = pytest.mark.slow

STRIDE = 2  # every other scan of the drive: 2 m apart, so odometry still follows
STEP_SIGMAS = np.repeat([np.radians(0.4), 0.08], 3)  # of each keyframe: a poor wheel odometry
STEP_BIAS = np.array([0.0, 0.0, np.radians(0.15), 0.03, 0.0, 0.0])  # and it errs to the left
ANCHOR = gtsam.noiseModel.Isotropic.Sigma(6, 1e-4)


@dataclass
class Drive:
    run: Run
    keyframes: list
    truth: np.ndarray


@pytest.fixture(scope="module")
def drive():
    """A lap and a bit of a simulated town, mapped by the pipeline, with its keyframes."""
    planned = plan_drive(build_town(builtin_road("demo"), seed=3), sensor="hdl32")
    indices = range(0, len(planned), STRIDE)
    config = load_config()
    slam, selector, keyframes = SlamPipeline(config), KeyframeSelector(config.keyframes), []
    for scan in simulate_drive(planned, indices):
        keyframe = selector.add(slam.process_scan(scan.points_lidar))
        if keyframe is not None:
            keyframes.append(keyframe)
    return Drive(slam.finish(), keyframes, planned.T_town_lidar[::STRIDE])


def test_plugin_and_pipeline_find_the_same_loops(drive):
    parameters = gtsam.ISAM2Params()
    parameters.setRelinearizeThreshold(0.05)
    parameters.relinearizeSkip = 1
    isam = gtsam.ISAM2(parameters)
    frontend = LineLoopFrontend(graph=isam.getFactorsUnsafe, odometry_factors=True)
    last = 0
    for keyframe in drive.keyframes:
        index = keyframe.scan_index
        update = frontend.add_keyframe(
            index, keyframe.points_lidar, keyframe.T_odom_lidar, max(index - last, 1)
        )
        if index == 0:
            start = gtsam.Pose3(keyframe.T_odom_lidar)
            update.factors.add(gtsam.PriorFactorPose3(0, start, ANCHOR))
        isam.update(update.factors, update.initial, update.revoked)
        for _ in range(2 * len(update.loops)):
            isam.update()
        frontend.update_estimates(isam.calculateEstimate())
        last = index
    frontend.settle()
    theirs = {(x.query_scan, x.target_scan): x for x in drive.run.loops}
    ours = {(v.loop.query_id, v.loop.target_id): v for v in frontend.verdicts}
    found = {pair for pair, loop in theirs.items() if loop.status != "rejected"}
    assert len(found) > 10
    assert {pair for pair, v in ours.items() if v.status != "rejected"} == found
    for pair in found:
        assert ours[pair].status == theirs[pair].status
        # registration starts from the live estimates, which differ in the last millimetres
        difference = invert(theirs[pair].T_target_query) @ ours[pair].loop.T_target_query
        assert distance_m(difference) < 0.01


def test_a_users_isam_with_poor_odometry_recovers_the_drive(drive, rng):
    truth = np.array([drive.truth[keyframe.scan_index] for keyframe in drive.keyframes])
    odometry = [truth[0]]
    for before, after in pairwise(truth):
        noise = exp(STEP_BIAS + STEP_SIGMAS * rng.standard_normal(6))
        odometry.append(odometry[-1] @ invert(before) @ after @ noise)
    config = load_config(
        overrides=[
            "graph.odometry_rotation_sigma_deg=0.4",
            "graph.odometry_translation_sigma_m=0.08",
        ]
    )
    isam = gtsam.ISAM2()
    frontend = LineLoopFrontend(config, graph=isam.getFactorsUnsafe)
    keys = [gtsam.symbol("ab"[k % 2], 900 - k) for k in range(len(truth))]
    for k, keyframe in enumerate(drive.keyframes):
        update = frontend.add_keyframe(keys[k], keyframe.points_lidar, odometry[k])
        if k == 0:
            update.factors.add(gtsam.PriorFactorPose3(keys[0], gtsam.Pose3(truth[0]), ANCHOR))
        else:
            step = gtsam.Pose3(invert(odometry[k - 1]) @ odometry[k])
            own = gtsam.noiseModel.Diagonal.Sigmas(STEP_SIGMAS)
            update.factors.add(gtsam.BetweenFactorPose3(keys[k - 1], keys[k], step, own))
        isam.update(update.factors, update.initial, update.revoked)
        frontend.update_estimates(isam.calculateEstimate())
    solved = np.array([isam.calculateEstimatePose3(key).matrix() for key in keys])
    assert any(verdict.status == "accepted" for verdict in frontend.verdicts)
    # loops within 30 m pin the ends of the lap alone, which keeps 0.4 of the drift
    assert ate_rmse_m(solved, truth) < 0.25 * ate_rmse_m(np.array(odometry), truth)


def test_another_day_is_found_in_the_saved_map(drive):
    later = plan_drive(build_town(builtin_road("demo"), seed=3), sensor="hdl32", day=1)
    indices = range(40, 80, 4)
    T_world_map = exp(np.array([0.0, 0.02, 1.1, -40.0, 25.0, 3.0]))  # the user's world, not ours
    odometry = [T_world_map @ later.T_town_lidar[index] for index in indices]
    frontend = LineLoopFrontend(odometry_factors=True)
    frontend.localize_against(drive.run.line_map)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    num_found = 0
    for k, scan in enumerate(simulate_drive(later, indices)):
        update = frontend.add_keyframe(k, scan.points_lidar, odometry[k], 4)
        graph.push_back(update.factors)
        values.insert(update.initial)
        num_found += len(update.loops)
    assert num_found >= 3
    graph.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(odometry[0]), ANCHOR))
    solved = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    found = solved.atPose3(gtsam.symbol("m", 0)).matrix()
    T_middle = later.T_town_lidar[60]  # where it matters; the map's origin is 60 m of lever away
    error = invert(T_world_map @ T_middle) @ found @ T_middle
    # the map is good to some 10 cm there, a relocalization in it to about 20 cm
    assert distance_m(error) < 0.4

"""Line loops in a factor graph of your own: python examples/04_own_factor_graph.py

Your iSAM2 holds what you have: odometry that drifts, GPS that jumps by metres, poses x0, x1, ...
where a lidar scan was taken and g0, g1, ... where GPS came in between. LineLoopFrontend adds loop
factors between the x and takes wrong ones back; it sees nothing else of the graph. (Simulated.)
"""

from itertools import pairwise

import gtsam
import numpy as np
from gtsam.symbol_shorthand import G, X

from sl3d_slam import LineLoopFrontend, load_config
from sl3d_slam.geometry.se3 import exp, invert
from sl3d_slam.report.metrics import ate_rmse_m
from sl3d_slam.simulation.drive import plan_drive, simulate_drive
from sl3d_slam.simulation.roads import builtin_road
from sl3d_slam.simulation.town import build_town

STEP_SIGMAS = np.array([0.004, 0.004, 0.004, 0.04, 0.04, 0.04])  # of the odometry: rad, m
GPS_SIGMA_M = 3.0
SCANS_A_STEP = 2


def noisy_odometry(truth: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    poses = [truth[0]]
    for before, after in pairwise(truth):
        noise = exp(STEP_SIGMAS * rng.standard_normal(6))
        poses.append(poses[-1] @ invert(before) @ after @ noise)
    return np.array(poses)


def start_factor(key: int, T_world_lidar: np.ndarray) -> gtsam.PriorFactorPose3:
    noise = gtsam.noiseModel.Isotropic.Sigma(6, 0.1)
    return gtsam.PriorFactorPose3(key, gtsam.Pose3(T_world_lidar), noise)


def gps_factor(key: int, T_world_lidar: np.ndarray, rng: np.random.Generator) -> gtsam.GPSFactor:
    position = T_world_lidar[:3, 3] + rng.normal(0.0, GPS_SIGMA_M, 3)
    return gtsam.GPSFactor(key, position, gtsam.noiseModel.Isotropic.Sigma(3, GPS_SIGMA_M))


def odometry_factor(
    keys: tuple[int, int], T_odom_last: np.ndarray, T_odom_new: np.ndarray
) -> gtsam.BetweenFactorPose3:
    T_last_new = gtsam.Pose3(invert(T_odom_last) @ T_odom_new)
    noise = gtsam.noiseModel.Diagonal.Sigmas(STEP_SIGMAS)
    return gtsam.BetweenFactorPose3(*keys, T_last_new, noise)


def make_frontend(isam: gtsam.ISAM2) -> LineLoopFrontend:
    config = load_config(  # how far to trust your odometry, one step of it
        overrides=[
            f"graph.odometry_rotation_sigma_deg={np.degrees(STEP_SIGMAS[0])}",
            f"graph.odometry_translation_sigma_m={STEP_SIGMAS[3]}",
        ]
    )
    return LineLoopFrontend(config, graph=isam.getFactorsUnsafe)


def main() -> None:
    rng = np.random.default_rng(4)
    drive = plan_drive(build_town(builtin_road("demo"), seed=3), sensor="hdl32")
    scans = simulate_drive(drive, range(0, len(drive), 2 * SCANS_A_STEP))
    truth = drive.T_town_lidar[::SCANS_A_STEP]
    odometry = noisy_odometry(truth, rng)
    keys = [X(k // 2) if k % 2 == 0 else G(k // 2) for k in range(len(truth))]

    isam = gtsam.ISAM2()
    frontend = make_frontend(isam)
    for k, key in enumerate(keys):
        factors, initial, revoked = gtsam.NonlinearFactorGraph(), gtsam.Values(), []
        if k == 0:
            factors.add(start_factor(key, truth[0]))
        else:
            factors.add(odometry_factor((keys[k - 1], key), odometry[k - 1], odometry[k]))
        if k % 2 == 0:
            scan = next(scans)
            update = frontend.add_keyframe(
                key, scan.points_lidar, odometry[k], num_scans_since_last=2
            )
            factors.push_back(update.factors)
            initial, revoked = update.initial, update.revoked
        else:
            factors.add(gps_factor(key, truth[k], rng))
            T_last_new = factors.at(0).measured()
            initial.insert(key, isam.calculateEstimatePose3(keys[k - 1]).compose(T_last_new))
        isam.update(factors, initial, revoked)
        frontend.update_estimates(isam.calculateEstimate())

    statuses = [verdict.status for verdict in frontend.verdicts]
    solved = np.array([isam.calculateEstimatePose3(key).matrix() for key in keys])
    print(f"{statuses.count('accepted')} line loops among {isam.getFactorsUnsafe().size()} factors")
    print(f"ATE of the odometry: {ate_rmse_m(odometry, truth):.2f} m")
    print(f"ATE of your graph:   {ate_rmse_m(solved, truth):.2f} m")


if __name__ == "__main__":
    main()

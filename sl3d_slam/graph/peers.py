"""The usual answers to false loops, over all poses at once; here to be compared with.

The odometry is believed in each; the loops are all believed (``gaussian``), down-weighted by an
M-estimator with the usual tuning, or chosen by gtsam's own GNC.
"""

from collections.abc import Sequence
from typing import Literal

import gtsam
import numpy as np
from jaxtyping import Float64

from sl3d_slam.errors import GraphError
from sl3d_slam.graph.batched import Transforms
from sl3d_slam.graph.noise import information_to_gtsam
from sl3d_slam.graph.solve import Edge, anchor, between_factor, prior_factor

Loss = Literal["gaussian", "huber", "cauchy", "dcs"]
HUBER_SIGMAS = 1.345  # 95 % efficiency with Gaussian noise
CAUCHY_SIGMAS = 1.0
DCS_PHI = 1.0


def solve_with_loss(
    T_odom_lidar: Transforms, odometry: Sequence[Edge], loops: Sequence[Edge], loss: Loss
) -> Transforms:
    """Return all poses by Levenberg-Marquardt with a loss on the loops.

    Raises GraphError where gtsam gives up.
    """
    graph, initial = _odometry_graph(T_odom_lidar, odometry)
    for loop in loops:
        noise: gtsam.noiseModel.Base = information_to_gtsam(loop.information)
        if loss != "gaussian":
            noise = gtsam.noiseModel.Robust.Create(_estimator(loss), noise)
        measured = gtsam.Pose3(loop.T_first_second)
        graph.add(gtsam.BetweenFactorPose3(loop.first, loop.second, measured, noise))
    try:
        solution = gtsam.LevenbergMarquardtOptimizer(graph, initial).optimize()
    except RuntimeError as error:
        raise GraphError(f"gtsam gives up: {str(error).splitlines()[0]}") from None
    return _poses(solution, len(T_odom_lidar))


def solve_with_gnc(
    T_odom_lidar: Transforms,
    odometry: Sequence[Edge],
    loops: Sequence[Edge],
    outlier_probability: float,
) -> tuple[Transforms, Float64[np.ndarray, "M"]]:
    """Return all poses and each loop's weight by gtsam's GNC-TLS, odometry as known inliers.

    Its early stops are off: distant false loops make the first weights so small that gtsam takes
    them all for zeros, and the cost change so little that it would end before it has begun.
    Raises GraphError where gtsam gives up.
    """
    graph, initial = _odometry_graph(T_odom_lidar, odometry)
    known = list(range(graph.size()))
    for loop in loops:
        graph.add(between_factor(loop))
    parameters = gtsam.GncLMParams(gtsam.LevenbergMarquardtParams())
    parameters.setKnownInliers(known)
    parameters.setRelativeCostTol(0.0)
    parameters.setWeightsTol(1e-12)
    optimizer = gtsam.GncLMOptimizer(graph, initial, parameters)
    optimizer.setInlierCostThresholdsAtProbability(1.0 - outlier_probability)
    try:
        solution = optimizer.optimize()
    except RuntimeError as error:
        raise GraphError(f"gtsam gives up: {str(error).splitlines()[0]}") from None
    weights = np.asarray(optimizer.getWeights(), dtype=np.float64)[len(known) :]
    return _poses(solution, len(T_odom_lidar)), weights


def _estimator(loss: Loss) -> gtsam.noiseModel.mEstimator.Base:
    match loss:
        case "huber":
            return gtsam.noiseModel.mEstimator.Huber(HUBER_SIGMAS)
        case "cauchy":
            return gtsam.noiseModel.mEstimator.Cauchy(CAUCHY_SIGMAS)
        case "dcs":
            return gtsam.noiseModel.mEstimator.DCS(DCS_PHI)
        case _:
            return gtsam.noiseModel.mEstimator.Null()


def _odometry_graph(
    T_odom_lidar: Transforms, odometry: Sequence[Edge]
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    graph, initial = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(prior_factor(anchor(0, T_odom_lidar[0])))
    for edge in odometry:
        graph.add(between_factor(edge))
    for scan, pose in enumerate(T_odom_lidar):
        initial.insert(scan, gtsam.Pose3(pose))
    return graph, initial


def _poses(solution: gtsam.Values, count: int) -> Transforms:
    return np.array([solution.atPose3(k).matrix() for k in range(count)])

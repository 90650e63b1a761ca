"""The last optimisation: every scan is a variable, every accepted loop a factor, noise Gaussian."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import gtsam
import numpy as np
from jaxtyping import Float64

from sl3d_slam.config import GraphSettings
from sl3d_slam.errors import GraphError
from sl3d_slam.geometry.se3 import Transform, invert
from sl3d_slam.graph.batched import Transforms, inverts
from sl3d_slam.graph.g2o import G2oGraph, format_g2o
from sl3d_slam.graph.noise import Matrix6, covariance_of_step, step_covariance
from sl3d_slam.graph.rigid import rigid_transforms
from sl3d_slam.graph.solve import Edge, Prior, anchor, optimise
from sl3d_slam.types import KeyframeCovariances, LoopConstraint

PoseCovariances = Sequence[Matrix6 | None]


@dataclass(frozen=True, slots=True, eq=False)
class FinalGraph:
    """A solved graph over all scans; its keys are scan indices.

    Attributes
    ----------
    T_world_lidar : (N, 4, 4), the world frame is the odometry's at the first scan.
    edges : odometry steps in order, then loops.
    priors : what holds the world frame.
    fixed : scans that a g2o file marks as held instead of by ``priors``.
    """

    T_world_lidar: Transforms
    edges: list[Edge]
    priors: list[Prior]
    fixed: tuple[int, ...] = ()

    @property
    def poses(self) -> dict[int, Transform]:
        """Return ``T_world_lidar`` by scan index."""
        return dict(enumerate(self.T_world_lidar))

    def to_g2o(self) -> str:
        """Return a g2o file's text: all scans, odometry and loops, and what holds the frame."""
        priors = [] if self.fixed else self.priors
        return format_g2o(G2oGraph(self.poses, self.edges, priors, list(self.fixed)))


def optimise_all_scans(
    T_odom_lidar: Transforms,
    scan_of_keyframe: Mapping[int, int],
    estimates: Mapping[int, Transform],
    loops: Sequence[LoopConstraint],
    settings: GraphSettings,
    pose_covariances: PoseCovariances = (),
) -> FinalGraph:
    """Spread the accepted loops over every scan of a run.

    Parameters
    ----------
    T_odom_lidar : (N, 4, 4) odometry pose of every scan.
    scan_of_keyframe : scan index of each keyframe id.
    estimates : live ``T_world_lidar`` of keyframes, the start; may be empty.
    loops : the loops to believe, between keyframe ids; they weigh by their information alone.
    pose_covariances : what odometry says of each pose, see :func:`odometry_edges`.

    Raises
    ------
    GraphError
        for poses that are not rigid, unknown keyframes and rank-deficient loops.
    """
    if len(T_odom_lidar) == 0:
        return FinalGraph(np.zeros((0, 4, 4)), [], [])
    odometry = rigid_transforms(T_odom_lidar, "the odometry")
    edges = odometry_edges(odometry, settings, pose_covariances)
    edges += [_loop_edge(loop, scan_of_keyframe) for loop in loops]
    priors = [anchor(0, odometry[0])]
    anchors = {_scan_of(key, scan_of_keyframe): pose for key, pose in estimates.items()}
    start = _spread(odometry, anchors)
    _, values = optimise(dict(enumerate(start)), edges, priors)
    poses = np.array([values.atPose3(index).matrix() for index in range(len(T_odom_lidar))])
    return FinalGraph(poses, edges, priors, fixed=(0,))


def keyframe_covariances(graph: FinalGraph, scans: Sequence[int]) -> KeyframeCovariances:
    """Return the marginals of the chosen scans of a solved graph, and what they refer to."""
    frame = "the first scan" if graph.fixed else "the world of GPS and gravity"
    return KeyframeCovariances(list(scans), marginal_covariances(graph, scans), frame)


def marginal_covariances(
    graph: FinalGraph, scan_indices: Sequence[int]
) -> Float64[np.ndarray, "K 6 6"]:
    """Return the covariance of the chosen scans' poses given all factors.

    Rotation first, each at its own lidar frame; relative to the first scan, or to the world where
    other sensors hold the graph.
    """
    factors, values = optimise(graph.poses, graph.edges, graph.priors)
    marginals = gtsam.Marginals(factors, values)
    found: list[Matrix6] = [marginals.marginalCovariance(int(index)) for index in scan_indices]
    return np.array(found).reshape(-1, 6, 6)


def odometry_edges(
    T_odom_lidar: Transforms, settings: GraphSettings, pose_covariances: PoseCovariances = ()
) -> list[Edge]:
    """Return the step from each scan to the next with its information.

    ``pose_covariances`` are those of the scans given the local map (rotation first, each at its own
    frame): a step errs as both its ends do. Where one is not known the settings speak.
    """
    known = list(pose_covariances) or [None] * len(T_odom_lidar)
    steps = inverts(T_odom_lidar[:-1]) @ T_odom_lidar[1:]
    covariances = [
        step_covariance(step, settings)
        if before is None or after is None
        else covariance_of_step(step, before, after)
        for step, (before, after) in zip(steps, pairwise(known), strict=True)
    ]
    return [
        Edge(k, k + 1, step, np.linalg.inv(covariance))
        for k, (step, covariance) in enumerate(zip(steps, covariances, strict=True))
    ]


def _loop_edge(loop: LoopConstraint, scan_of_keyframe: Mapping[int, int]) -> Edge:
    target = _scan_of(loop.target_id, scan_of_keyframe)
    query = _scan_of(loop.query_id, scan_of_keyframe)
    return Edge(target, query, loop.T_target_query, loop.information)


def _scan_of(keyframe_id: int, scan_of_keyframe: Mapping[int, int]) -> int:
    if keyframe_id not in scan_of_keyframe:
        raise GraphError(f"no scan belongs to keyframe {keyframe_id}")
    return scan_of_keyframe[keyframe_id]


def _spread(T_odom_lidar: Transforms, anchors: Mapping[int, Transform]) -> Transforms:
    """Start every scan from the keyframe before it: ``T_world_kf T_kf_odom T_odom_lidar``."""
    start = T_odom_lidar.copy()
    bounds = [*sorted(anchors), len(T_odom_lidar)]
    for first, last in pairwise(bounds):
        T_world_odom = anchors[first] @ invert(T_odom_lidar[first])
        start[first:last] = T_world_odom @ T_odom_lidar[first:last]
    return start

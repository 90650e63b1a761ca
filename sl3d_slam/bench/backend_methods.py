"""The back ends that ``bench backend`` compares, each over the same odometry and loops."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import Bool, Float64

from sl3d_slam.bench.backend_world import BackendWorld, Poses
from sl3d_slam.config import GraphSettings
from sl3d_slam.graph.arbiter import LoopArbiter
from sl3d_slam.graph.final import odometry_edges, optimise_all_scans
from sl3d_slam.graph.peers import Loss, solve_with_gnc, solve_with_loss
from sl3d_slam.graph.pose_graph import PoseGraph
from sl3d_slam.graph.solve import Edge

Kept = Bool[np.ndarray, "M"]
Times = Float64[np.ndarray, "N"]


@dataclass(frozen=True, slots=True, eq=False)
class BackendAnswer:
    """What a method makes of a world.

    Attributes
    ----------
    T_world_lidar : the pose of every scan.
    kept : which loops the method kept; None where it keeps all and weighs them.
    updates_ms : processor time of every scan and its loops, of a method that goes scan by scan.
    """

    T_world_lidar: Poses
    kept: Kept | None
    updates_ms: Times | None = None


def oracle(world: BackendWorld, settings: GraphSettings) -> BackendAnswer:
    """Optimise with the true loops alone: the best that any method could do."""
    kept = np.array(world.is_true, dtype=bool)
    return BackendAnswer(_final(world, kept, settings), kept)


def ours(world: BackendWorld, settings: GraphSettings) -> BackendAnswer:
    """Judge all loops together, then optimise over all scans: what a finished drive needs."""
    arbiter = LoopArbiter(settings)
    for scan, pose in enumerate(world.T_odom_lidar):
        arbiter.add_keyframe(scan, pose, 1)
    verdicts = arbiter.offer_all(world.loops)
    kept = np.array([verdict.status == "accepted" for verdict in verdicts], dtype=bool)
    return BackendAnswer(_final(world, kept, settings), kept)


def ours_live(world: BackendWorld, settings: GraphSettings) -> BackendAnswer:
    """Run the product's graph as a drive would: scan by scan, each loop when it is met."""
    graph, updates_ms = drive_live(world, settings)
    graph.settle()
    kept = np.array([verdict.status == "accepted" for verdict in graph.verdicts], dtype=bool)
    same = {scan: scan for scan in range(len(world.T_odom_lidar))}
    final = optimise_all_scans(
        world.T_odom_lidar, same, graph.estimates(), graph.accepted_loops, settings
    )
    return BackendAnswer(final.T_world_lidar, kept, updates_ms)


def drive_live(
    world: BackendWorld, settings: GraphSettings, count: Callable[[int], None] = lambda done: None
) -> tuple[PoseGraph, Times]:
    """Build the live graph scan by scan; return it and the processor time of each update.

    ``count`` is told how many scans are done.
    """
    graph = PoseGraph(settings)
    updates_ms = np.zeros(len(world.T_odom_lidar))
    offered = 0
    for scan, pose in enumerate(world.T_odom_lidar):
        start_s = time.process_time()
        graph.add_keyframe(scan, pose, 1)
        while offered < len(world.loops) and world.loops[offered].query_id == scan:
            graph.add_loop(world.loops[offered])
            offered += 1
        updates_ms[scan] = 1e3 * (time.process_time() - start_s)
        count(scan + 1)
    return graph, updates_ms


def with_loss(world: BackendWorld, settings: GraphSettings, loss: Loss) -> BackendAnswer:
    """Keep every loop, under a loss function, over all poses at once."""
    odometry = odometry_edges(world.T_odom_lidar, settings)
    poses = solve_with_loss(world.T_odom_lidar, odometry, _loop_edges(world), loss)
    return BackendAnswer(poses, None)


def gnc_all_poses(world: BackendWorld, settings: GraphSettings) -> BackendAnswer:
    """Run gtsam's GNC-TLS over all poses."""
    poses, weights = solve_with_gnc(
        world.T_odom_lidar,
        odometry_edges(world.T_odom_lidar, settings),
        _loop_edges(world),
        settings.gnc_outlier_probability,
    )
    return BackendAnswer(poses, weights > 0.5)


METHODS: dict[str, Callable[[BackendWorld, GraphSettings], BackendAnswer]] = {
    "oracle": oracle,
    "ours": ours,
    "ours, live": ours_live,
    "LM": partial(with_loss, loss="gaussian"),
    "Huber": partial(with_loss, loss="huber"),
    "Cauchy": partial(with_loss, loss="cauchy"),
    "DCS": partial(with_loss, loss="dcs"),
    "GNC, all poses": gnc_all_poses,
}


def _final(world: BackendWorld, kept: Kept, settings: GraphSettings) -> Poses:
    loops = [world.loops[k] for k in np.flatnonzero(kept)]
    same = {scan: scan for scan in range(len(world.T_odom_lidar))}
    return optimise_all_scans(world.T_odom_lidar, same, {}, loops, settings).T_world_lidar


def _loop_edges(world: BackendWorld) -> list[Edge]:
    return [
        Edge(loop.target_id, loop.query_id, loop.T_target_query, loop.information)
        for loop in world.loops
    ]

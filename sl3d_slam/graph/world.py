"""A solved drive and other people's measurements: the poses in the world, and where the map lies.

The poses are optimised in the world's own frame (east, north, up; or level, where there is no
GPS), so the map's pose in it is no variable of its own: it is what the first scan's pose says.
First all fixes count under Huber's loss, then those beyond a chi-square bound are left out until
the set no longer changes; what remains is Gaussian.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import gtsam
import numpy as np
from jaxtyping import Bool

from sl3d_slam.config import WorldSettings
from sl3d_slam.errors import GraphError
from sl3d_slam.geometry.geodesy import GeoReference
from sl3d_slam.geometry.se3 import Transform, exp, invert, transform_points
from sl3d_slam.graph.batched import Transforms
from sl3d_slam.graph.final import FinalGraph
from sl3d_slam.graph.fixes import (
    Fix,
    attach_positions,
    position_fixes,
    require_overlap,
    up_fixes,
)
from sl3d_slam.graph.heading import align_yaw
from sl3d_slam.graph.solve import Prior, between_factor, levenberg_marquardt, prior_factor
from sl3d_slam.types import Trajectory, WorldMeasurements

LEVEL_RAD = np.radians(10.0)  # how level a lidar is mounted, where nothing else tells
HELD = 1e-3  # rad and m; nothing pulls against it
LOOSE = 300.0  # rad and m: as good as free, and gtsam can still invert it
MAX_ROUNDS = 8
SHIFT_RATHER = np.repeat([1e-3, 1.0], 3)
WEAKEST = 2e-6  # information of free directions, the least that may enter a graph


@dataclass(frozen=True, slots=True, eq=False)
class WorldGraph:
    """A drive in the world.

    Attributes
    ----------
    graph : the solved graph in the map's frame; its priors stand for the fixes that count.
    T_world_map : ``p_world = T_world_map @ p_map``; the world is ENU with GPS, else level.
    num_used, num_given : fixes that count, among those that fall into the drive.
    georeference : ``T_world_map`` and its origin, where there is GPS.
    """

    graph: FinalGraph
    T_world_map: Transform
    num_used: int
    num_given: int
    georeference: GeoReference | None

    def facts(self) -> dict[str, Any]:
        """Return what ``run.json`` tells of it."""
        return {
            "fixes_used": self.num_used,
            "fixes_given": self.num_given,
            "T_world_map": self.T_world_map.tolist(),
        }


def place_in_world(
    final: FinalGraph,
    odometry: Trajectory,
    measurements: WorldMeasurements,
    settings: WorldSettings,
) -> WorldGraph:
    """Optimise a solved drive once more, with positions and up directions of other sensors.

    Raises GraphError where clocks do not overlap, the heading stays open, or most fixes contradict
    the drive.
    """
    require_overlap(measurements, odometry.stamps_s)
    fixes: list[Fix] = []
    T_world_map = np.eye(4)
    if measurements.positions is not None:
        attached = attach_positions(measurements.positions, odometry, settings)
        poses = final.T_world_lidar[attached.scans]
        antennas_map = np.array(
            [
                transform_points(T, point[None])[0]
                for T, point in zip(poses, attached.antennas, strict=True)
            ]
        )
        T_world_map = align_yaw(antennas_map, attached.positions, attached.sigmas_m)
        fixes += position_fixes(attached, settings)
    if measurements.ups is not None:
        fixes += up_fixes(measurements.ups, odometry, settings)
    start = _first_scan(T_world_map @ final.T_world_lidar[0], measurements)
    values, used = _solve(final, fixes, T_world_map, start)
    world = _in_map_frame(final, values, start, fixes, used)
    if measurements.positions is None:
        return world
    place = GeoReference(world.T_world_map, measurements.positions.origin)
    return replace(world, georeference=place)


def _first_scan(T_world_lidar: Transform, measurements: WorldMeasurements) -> Prior:
    """Hold what nothing measures: place and heading without GPS; tilt, weakly, in any case."""
    rest = HELD if measurements.positions is None else LOOSE
    level = LEVEL_RAD if measurements.ups is None else LOOSE
    sigmas = np.array([level, level, rest, rest, rest, rest])
    return Prior(0, T_world_lidar, np.diag(sigmas**-2.0))


def _solve(
    final: FinalGraph, fixes: Sequence[Fix], T_world_map: Transform, start: Prior
) -> tuple[gtsam.Values, Bool[np.ndarray, "N"]]:
    base = gtsam.NonlinearFactorGraph()
    base.add(prior_factor(start))
    for edge in final.edges:
        base.add(between_factor(edge))
    values = gtsam.Values()
    for scan, T_map_lidar in final.poses.items():
        values.insert(scan, gtsam.Pose3(T_world_map @ T_map_lidar))
    factors = [fix.cautious for fix in fixes]
    used = np.zeros(len(fixes), dtype=bool)
    for _ in range(MAX_ROUNDS):
        graph = gtsam.NonlinearFactorGraph(base)
        for factor in factors:
            graph.add(factor)
        values = levenberg_marquardt(graph, values)
        now = np.array([2.0 * fix.honest.error(values) <= fix.threshold for fix in fixes])
        if np.array_equal(now, used):
            break
        used = now
        factors = [fix.honest for fix in _chosen(fixes, used)]
    if 2 * int(used.sum()) < len(fixes):
        raise GraphError(
            f"only {int(used.sum())} of {len(fixes)} fixes of other sensors fit the drive; "
            "expected most: check their clock, their sigmas and world.antenna_*"
        )
    return values, used


def _chosen(fixes: Sequence[Fix], used: Bool[np.ndarray, "N"]) -> list[Fix]:
    return [fix for fix, counts in zip(fixes, used, strict=True) if counts]


def _in_map_frame(
    final: FinalGraph,
    values: gtsam.Values,
    start: Prior,
    fixes: Sequence[Fix],
    used: Bool[np.ndarray, "N"],
) -> WorldGraph:
    poses: Transforms = np.array([values.atPose3(k).matrix() for k in range(len(final.poses))])
    T_world_map = poses[0] @ invert(final.T_world_lidar[0])
    T_map_world = invert(T_world_map)
    priors = [replace(start, T_world_key=T_map_world @ start.T_world_key)]
    priors += [
        prior_of(fix.honest, fix.scan, T_map_world @ poses[fix.scan], values)
        for fix in _chosen(fixes, used)
    ]
    graph = replace(final, T_world_lidar=T_map_world @ poses, priors=priors, fixed=())
    return WorldGraph(graph, T_world_map, int(used.sum()), len(used), None)


def prior_of(
    factor: gtsam.NonlinearFactor, scan: int, T_map_lidar: Transform, values: gtsam.Values
) -> Prior:
    """Return the pose prior that stands for a factor on one pose, near the solution.

    To first order both pull alike; directions that the factor leaves free are held by next to
    nothing. The prior lies off the pose by a shift where the factor allows one: a turn would bend
    its error.
    """
    A, b = factor.linearize(values).jacobian()
    shift = SHIFT_RATHER * (np.linalg.pinv(A * SHIFT_RATHER, rcond=1e-9) @ b)
    return Prior(scan, T_map_lidar @ exp(shift), A.T @ A + WEAKEST * np.eye(6))

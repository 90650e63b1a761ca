"""Where is one scan in the frame of another? No first guess, no sampling, a reasoned no.

Lines propose every pose, a bird's-eye field of the coarse clouds judges the best few thousand,
GICP refines the few that are left, and the visibility test decides.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float64

from sl3d_slam.config import MatchingSettings
from sl3d_slam.geometry.se3 import Points, Transform, from_yaw, invert, transform_points
from sl3d_slam.matching import dense, field, visibility
from sl3d_slam.matching.consistency import enumerate_poses, thin_poses
from sl3d_slam.matching.verticals import Verticals, find_verticals, levelling
from sl3d_slam.types import View

DISTINCT_M = 2.0
DISTINCT_RAD = np.radians(8.0)


class PreparedView:
    """A view with what matching derives from it, each part made when first needed."""

    def __init__(self, view: View, settings: MatchingSettings) -> None:
        self.view = view
        self._settings = settings

    @cached_property
    def T_level_lidar(self) -> Transform:
        """The turn that makes the frame level."""
        return levelling(self.view.up)

    @cached_property
    def verticals(self) -> Verticals:
        """The standing lines in the levelled frame."""
        angle = np.radians(2.0 * self._settings.angle_tolerance_deg)
        return find_verticals(self.view.lines, self.T_level_lidar, angle)

    @cached_property
    def level_points(self) -> Points:
        """The coarse cloud in the levelled frame."""
        return transform_points(self.T_level_lidar, self.view.cloud.astype(np.float64))

    @cached_property
    def field(self) -> field.StructureField:
        """The coarse cloud seen from above."""
        return field.build_field(self.view, self.T_level_lidar)

    @cached_property
    def image(self) -> np.ndarray:
        """The coarse cloud seen from the sensor."""
        return visibility.range_image(self.level_points)

    @cached_property
    def dense(self) -> dense.DenseCloud | None:
        """The coarse cloud ready for GICP."""
        return dense.prepare(self.view.cloud)


@dataclass(frozen=True, slots=True, eq=False)
class Hypothesis:
    """One refined pose and what speaks for it."""

    T_target_source: Transform
    hessian: Float64[np.ndarray, "6 6"]
    overlap: float
    seen: visibility.Visibility


def planar_seeds(
    source: PreparedView, target: PreparedView, settings: MatchingSettings
) -> tuple[np.ndarray, np.ndarray]:
    """Return distinct planar poses (yaw, x, y) and their combined score, best first."""
    poses, line_scores = enumerate_poses(
        source.verticals,
        target.verticals,
        settings.distance_tolerance_m,
        settings.inlier_distance_m,
    )
    poses, line_scores = thin_poses(poses, line_scores, settings.max_hypotheses)
    return rank_poses(source, target, poses, line_scores)


def rank_poses(
    source: PreparedView, target: PreparedView, poses: np.ndarray, line_scores: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Order planar poses by the fields of both sides and the lines together."""
    forward = field.score_poses(source.field, target.field, poses)
    backward = field.score_poses(target.field, source.field, field.invert_poses(poses))
    scores = forward + backward + 0.05 * line_scores
    order = np.argsort(-scores, kind="stable")
    return poses[order], scores[order]


def distinct(poses: np.ndarray, limit: int) -> np.ndarray:
    """Return indices of the first poses that differ from all chosen before them."""
    chosen: list[int] = []
    for k in range(len(poses)):
        apart = [
            np.hypot(*(poses[k, 1:] - poses[c, 1:])) > DISTINCT_M
            or abs(np.angle(np.exp(1j * (poses[k, 0] - poses[c, 0])))) > DISTINCT_RAD
            for c in chosen
        ]
        if all(apart):
            chosen.append(k)
            if len(chosen) == limit:
                break
    return np.array(chosen, np.int64)


def lift(source: PreparedView, target: PreparedView, pose: np.ndarray) -> Transform:
    """Turn a planar pose of levelled frames into ``T_target_source``; the ground gives z."""
    at_source = _ground_height_m(source, np.zeros(2))
    at_target = _ground_height_m(target, pose[1:])
    T_level_level = from_yaw(pose[0], np.array([pose[1], pose[2], at_target - at_source]))
    return invert(target.T_level_lidar) @ T_level_level @ source.T_level_lidar


def refine(source: PreparedView, target: PreparedView, T_guess: Transform) -> Hypothesis | None:
    """Refine a guess by GICP and look through both scans; None without clouds to do it with."""
    if source.dense is None or target.dense is None:
        return None
    aligned = dense.align(target.dense, source.dense, T_guess)
    T_levels = target.T_level_lidar @ aligned.T_target_source @ invert(source.T_level_lidar)
    seen = visibility.compare(target.image, source.level_points, T_levels)
    seen = seen + visibility.compare(source.image, target.level_points, invert(T_levels))
    return Hypothesis(aligned.T_target_source, aligned.hessian, aligned.overlap, seen)


def _ground_height_m(prepared: PreparedView, xy: np.ndarray) -> float:
    ground = np.abs(prepared.view.heights) < field.GROUND_M
    points = prepared.level_points[ground]
    near = np.hypot(points[:, 0] - xy[0], points[:, 1] - xy[1]) < 8.0
    return float(np.median(points[near, 2])) if near.sum() >= 5 else 0.0

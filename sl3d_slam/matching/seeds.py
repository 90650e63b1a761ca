"""Planar poses that standing lines suggest, and which of them are different answers."""

import numpy as np

from sl3d_slam.config import MatchingSettings
from sl3d_slam.matching.consistency import PlanarPoses, enumerate_poses, thin_poses
from sl3d_slam.matching.prepared import PreparedView

DISTINCT_M = 2.0
DISTINCT_RAD = np.radians(8.0)


def line_poses(
    source: PreparedView, target: PreparedView, settings: MatchingSettings
) -> tuple[PlanarPoses, np.ndarray]:
    """Return the planar poses that lines alone like best, with their line scores, best first."""
    poses, scores = enumerate_poses(
        source.verticals,
        target.verticals,
        settings.distance_tolerance_m,
        settings.inlier_distance_m,
    )
    return thin_poses(poses, scores, settings.max_hypotheses)


def distinct(poses: PlanarPoses, limit: int) -> np.ndarray:
    """Return indices of the first poses that differ from all chosen before them."""
    chosen: list[int] = []
    for k in range(len(poses)):
        shift = np.hypot(*(poses[chosen, 1:] - poses[k, 1:]).T)
        turn = np.abs(np.angle(np.exp(1j * (poses[chosen, 0] - poses[k, 0]))))
        if np.all((shift > DISTINCT_M) | (turn > DISTINCT_RAD)):
            chosen.append(k)
            if len(chosen) == limit:
                break
    return np.array(chosen, np.int64)

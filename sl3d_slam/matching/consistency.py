"""Every pose that two line pairs suggest, scored by all lines: consensus without sampling.

The distance between two standing lines does not change with the view. Each pair of source lines
meets each pair of target lines of about the same distance; two such pairs fix yaw and shift. All
of them are tried, so the best-supported pose among them is found for certain (no RANSAC).
"""

import numpy as np
from jaxtyping import Float32, Float64, Int64

from sl3d_slam.matching.two_line_poses import match_pairs, rasterise, score_poses
from sl3d_slam.matching.verticals import Verticals
from sl3d_slam.side_by_side import side_by_side

MIN_BASELINE_M = 3.0
MAX_BASELINE_M = 80.0
LOOKED_AT = 4  # poses, for each that is kept
MANY_POSES = 20_000  # take milliseconds, more than it costs to share them out

PlanarPoses = Float64[np.ndarray, "H 3"]  # yaw_rad, x_m, y_m of T_target_source, levelled frames


def similarity(source: Verticals, target: Verticals) -> Float32[np.ndarray, "S T"]:
    """Return a soft weight in [0.3, 1] for each pair of lines: descriptors, where both have any.

    A hard gate by descriptor loses recall between views 30 m apart; a weight does not.
    """
    if source.descriptors.shape[1] == 0 or target.descriptors.shape[1] == 0:
        return np.ones((len(source), len(target)), np.float32)
    cosine = source.descriptors @ target.descriptors.T
    return (0.3 + 0.7 * np.clip(cosine, 0.0, 1.0)).astype(np.float32)


def enumerate_poses(
    source: Verticals, target: Verticals, tolerance_m: float, inlier_distance_m: float
) -> tuple[PlanarPoses, Float64[np.ndarray, "H"]]:
    """Return every two-pair pose with its line score, in the order of the pairs.

    The score of a pose is the weighted number of source lines with a target line nearby, each
    counting ``1 - (d / inlier_distance)^2`` times its similarity.
    """
    if len(source) < 2 or len(target) < 2:
        return np.zeros((0, 3)), np.zeros(0)
    source_pairs, source_m = _pairs(source.xy)
    target_pairs, target_m = _pairs(target.xy)
    poses = match_pairs(
        source.xy, target.xy, source_pairs, source_m, target_pairs, target_m, tolerance_m
    )
    raster, corner = rasterise(target.xy, inlier_distance_m)
    weights = np.sqrt(source.weights[:, None] * target.weights[None, :])
    weights = (similarity(source, target) * weights).astype(np.float32)

    def score(some: np.ndarray) -> np.ndarray:
        return score_poses(some, source.xy, target.xy, weights, raster, corner, inlier_distance_m)

    if len(poses) < MANY_POSES:
        return poses[:, :3], score(poses)
    halves = np.array_split(poses, 2)
    return poses[:, :3], np.concatenate(side_by_side(score, *halves))


def thin_poses(
    poses: PlanarPoses, scores: Float64[np.ndarray, "H"], limit: int
) -> tuple[Float64[np.ndarray, "K 3"], Float64[np.ndarray, "K"]]:
    """Return the best poses, best first, of those that share a cell of 0.5 m and 2 degrees one.

    Of poses that score alike the earlier one is the better.
    """
    looked_at = LOOKED_AT * limit
    while True:
        best = _best_rows(scores, looked_at)
        cells = np.floor(poses[best] / np.array([np.radians(2.0), 0.5, 0.5])).astype(np.int64)
        keys = (cells[:, 0] * 100_003 + cells[:, 1]) * 100_003 + cells[:, 2]
        first = np.sort(np.unique(keys, return_index=True)[1])[:limit]
        if len(first) == limit or len(best) == len(scores):
            return poses[best[first]], scores[best[first]]
        looked_at *= LOOKED_AT


def _best_rows(scores: Float64[np.ndarray, "H"], count: int) -> Int64[np.ndarray, "B"]:
    """Return the rows of the best scores, best first: so many and those as good as the last."""
    rows = np.arange(len(scores))
    if count < len(scores):
        rows = np.flatnonzero(scores >= np.partition(scores, -count)[-count])
    return rows[np.argsort(-scores[rows], kind="stable")]


def match_verticals(
    source: Verticals, target: Verticals, pose: Float64[np.ndarray, "3"], distance_m: float
) -> np.ndarray:
    """Return (M, 2) mutual nearest lines within a distance under a pose, source first."""
    if len(source) == 0 or len(target) == 0:
        return np.zeros((0, 2), np.int64)
    c, s = np.cos(pose[0]), np.sin(pose[0])
    moved = source.xy @ np.array([[c, s], [-s, c]]) + pose[1:]
    gap = np.linalg.norm(moved[:, None] - target.xy[None], axis=2)
    nearest = gap.argmin(axis=1)
    mutual = gap.argmin(axis=0)[nearest] == np.arange(len(source))
    keep = np.flatnonzero(mutual & (gap[np.arange(len(source)), nearest] < distance_m))
    return np.stack([keep, nearest[keep]], axis=1).astype(np.int64)


def _pairs(xy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return unordered pairs sorted by distance, within the useful baselines."""
    first, second = np.triu_indices(len(xy), k=1)
    distance = np.linalg.norm(xy[first] - xy[second], axis=1)
    keep = np.flatnonzero((distance > MIN_BASELINE_M) & (distance < MAX_BASELINE_M))
    keep = keep[np.argsort(distance[keep], kind="stable")]
    return np.stack([first[keep], second[keep]], axis=1), distance[keep]

"""Every pose that two line pairs suggest, scored by all lines: consensus without sampling.

The distance between two standing lines does not change with the view. Each pair of source lines
meets each pair of target lines of about the same distance; two such pairs fix yaw and shift. All
of them are tried, so the best-supported pose among them is found for certain (no RANSAC).
"""

from typing import no_type_check

import numpy as np
from jaxtyping import Float32, Float64
from numba import njit

from sl3d_slam.matching.verticals import Verticals

MIN_BASELINE_M = 3.0
MAX_BASELINE_M = 80.0
RASTER_CELL_M = 0.5

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
    """Return every two-pair pose with its line score, best first; ties keep pair order.

    The score of a pose is the weighted number of source lines with a target line nearby, each
    counting ``1 - (d / inlier_distance)^2`` times its similarity.
    """
    if len(source) < 2 or len(target) < 2:
        return np.zeros((0, 3)), np.zeros(0)
    source_pairs, source_m = _pairs(source.xy)
    target_pairs, target_m = _pairs(target.xy)
    poses = _match_pairs(
        source.xy, target.xy, source_pairs, source_m, target_pairs, target_m, tolerance_m
    )
    raster, corner = _rasterise(target.xy, inlier_distance_m)
    weights = np.sqrt(source.weights[:, None] * target.weights[None, :])
    scores = _score_poses(
        poses,
        source.xy,
        target.xy,
        (similarity(source, target) * weights).astype(np.float32),
        raster,
        corner,
        inlier_distance_m,
    )
    order = np.argsort(-scores, kind="stable")
    return poses[order, :3], scores[order]


def thin_poses(
    poses: PlanarPoses, scores: Float64[np.ndarray, "H"], limit: int
) -> tuple[Float64[np.ndarray, "K 3"], Float64[np.ndarray, "K"]]:
    """Keep the first (best) of the poses that fall into one cell of 0.5 m and 2 degrees."""
    poses, scores = poses[: 20 * limit], scores[: 20 * limit]
    cells = np.floor(poses / np.array([np.radians(2.0), 0.5, 0.5])).astype(np.int64)
    keys = (cells[:, 0] * 100_003 + cells[:, 1]) * 100_003 + cells[:, 2]
    _, first = np.unique(keys, return_index=True)
    keep = np.sort(first)[:limit]
    return poses[keep], scores[keep]


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


@njit(cache=True)
@no_type_check
def _match_pairs(  # noqa: PLR0913
    source_xy: np.ndarray,
    target_xy: np.ndarray,
    source_pairs: np.ndarray,
    source_m: np.ndarray,
    target_pairs: np.ndarray,
    target_m: np.ndarray,
    tolerance_m: float,
) -> np.ndarray:
    """Return rows of yaw, x, y, and the yaw's cosine and sine."""
    starts = np.searchsorted(target_m, source_m - tolerance_m)
    ends = np.searchsorted(target_m, source_m + tolerance_m)
    source_at, target_at = _lie(source_xy, source_pairs), _lie(target_xy, target_pairs)
    poses = np.empty((2 * np.sum(ends - starts), 5))
    h = 0
    for p in range(len(source_m)):
        for q in range(starts[p], ends[p]):
            yaw = target_at[q, 0] - source_at[p, 0]
            yaw -= 2.0 * np.pi * np.round(yaw / (2.0 * np.pi))
            cosine, sine = np.cos(yaw), np.sin(yaw)
            for _ in range(2):
                poses[h, 0], poses[h, 3], poses[h, 4] = yaw, cosine, sine
                turned_x = cosine * source_at[p, 1] - sine * source_at[p, 2]
                turned_y = sine * source_at[p, 1] + cosine * source_at[p, 2]
                poses[h, 1] = target_at[q, 1] - turned_x
                poses[h, 2] = target_at[q, 2] - turned_y
                h += 1
                yaw += np.pi if yaw < 0.0 else -np.pi
                cosine, sine = -cosine, -sine
    return poses


@njit(cache=True)
@no_type_check
def _lie(xy: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Return the angle of each pair's baseline and its middle."""
    found = np.empty((len(pairs), 3))
    for p in range(len(pairs)):
        a, b = xy[pairs[p, 0]], xy[pairs[p, 1]]
        found[p, 0] = np.arctan2(b[1] - a[1], b[0] - a[0])
        found[p, 1], found[p, 2] = 0.5 * (a[0] + b[0]), 0.5 * (a[1] + b[1])
    return found


@njit(cache=True)
@no_type_check
def _rasterise(target_xy: np.ndarray, radius_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a grid that names the target line nearest to each cell; any where none is near."""
    margin = radius_m + RASTER_CELL_M
    corner = np.array([target_xy[:, 0].min() - margin, target_xy[:, 1].min() - margin])
    nx = int((target_xy[:, 0].max() + margin - corner[0]) / RASTER_CELL_M) + 1
    ny = int((target_xy[:, 1].max() + margin - corner[1]) / RASTER_CELL_M) + 1
    raster = np.zeros((nx, ny), np.int32)
    best = np.full((nx, ny), np.inf)
    reach = int(margin / RASTER_CELL_M) + 1
    for k in range(len(target_xy)):
        i0 = int((target_xy[k, 0] - corner[0]) / RASTER_CELL_M)
        j0 = int((target_xy[k, 1] - corner[1]) / RASTER_CELL_M)
        for i in range(max(0, i0 - reach), min(nx, i0 + reach + 1)):
            for j in range(max(0, j0 - reach), min(ny, j0 + reach + 1)):
                dx = corner[0] + (i + 0.5) * RASTER_CELL_M - target_xy[k, 0]
                dy = corner[1] + (j + 0.5) * RASTER_CELL_M - target_xy[k, 1]
                if dx * dx + dy * dy < best[i, j]:
                    best[i, j] = dx * dx + dy * dy
                    raster[i, j] = k
    return raster, corner


@njit(cache=True)
@no_type_check
def _score_poses(  # noqa: PLR0913
    poses: np.ndarray,
    source_xy: np.ndarray,
    target_xy: np.ndarray,
    weights: np.ndarray,
    raster: np.ndarray,
    corner: np.ndarray,
    radius_m: float,
) -> np.ndarray:
    scores = np.zeros(len(poses))
    source, target = source_xy / RASTER_CELL_M, (target_xy - corner) / RASTER_CELL_M
    reach = (RASTER_CELL_M / radius_m) ** 2
    last_u, last_v = raster.shape[0] - 1, raster.shape[1] - 1
    for h in range(len(poses)):
        cosine, sine = poses[h, 3], poses[h, 4]
        at_u = (poses[h, 1] - corner[0]) / RASTER_CELL_M
        at_v = (poses[h, 2] - corner[1]) / RASTER_CELL_M
        total = 0.0
        for i in range(len(source)):
            u = cosine * source[i, 0] - sine * source[i, 1] + at_u
            v = sine * source[i, 0] + cosine * source[i, 1] + at_v
            k = raster[max(0, min(int(u), last_u)), max(0, min(int(v), last_v))]
            gap = ((u - target[k, 0]) ** 2 + (v - target[k, 1]) ** 2) * reach
            total += weights[i, k] * max(1.0 - gap, 0.0)
        scores[h] = total
    return scores

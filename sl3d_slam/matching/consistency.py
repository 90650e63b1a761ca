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
    return poses[order], scores[order]


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
    starts = np.searchsorted(target_m, source_m - tolerance_m)
    ends = np.searchsorted(target_m, source_m + tolerance_m)
    poses = np.empty((2 * np.sum(ends - starts), 3))
    h = 0
    for p in range(len(source_m)):
        a, b = source_xy[source_pairs[p, 0]], source_xy[source_pairs[p, 1]]
        angle = np.arctan2(b[1] - a[1], b[0] - a[0])
        middle_x, middle_y = 0.5 * (a[0] + b[0]), 0.5 * (a[1] + b[1])
        for q in range(starts[p], ends[p]):
            c, d = target_xy[target_pairs[q, 0]], target_xy[target_pairs[q, 1]]
            yaw = np.arctan2(d[1] - c[1], d[0] - c[0]) - angle
            for _ in range(2):
                cosine, sine = np.cos(yaw), np.sin(yaw)
                poses[h, 0] = np.arctan2(sine, cosine)
                poses[h, 1] = 0.5 * (c[0] + d[0]) - (cosine * middle_x - sine * middle_y)
                poses[h, 2] = 0.5 * (c[1] + d[1]) - (sine * middle_x + cosine * middle_y)
                h += 1
                yaw += np.pi
    return poses


@njit(cache=True)
@no_type_check
def _rasterise(target_xy: np.ndarray, radius_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a grid that names the target line nearest to each cell, -1 where none is near."""
    margin = radius_m + RASTER_CELL_M
    corner = np.array([target_xy[:, 0].min() - margin, target_xy[:, 1].min() - margin])
    nx = int((target_xy[:, 0].max() + margin - corner[0]) / RASTER_CELL_M) + 1
    ny = int((target_xy[:, 1].max() + margin - corner[1]) / RASTER_CELL_M) + 1
    raster = np.full((nx, ny), -1, np.int32)
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
    for h in range(len(poses)):
        cosine, sine = np.cos(poses[h, 0]), np.sin(poses[h, 0])
        total = 0.0
        for i in range(len(source_xy)):
            x = cosine * source_xy[i, 0] - sine * source_xy[i, 1] + poses[h, 1]
            y = sine * source_xy[i, 0] + cosine * source_xy[i, 1] + poses[h, 2]
            u, v = (x - corner[0]) / RASTER_CELL_M, (y - corner[1]) / RASTER_CELL_M
            if u < 0.0 or v < 0.0 or u >= raster.shape[0] or v >= raster.shape[1]:
                continue
            k = raster[int(u), int(v)]
            if k >= 0:
                gap = ((x - target_xy[k, 0]) ** 2 + (y - target_xy[k, 1]) ** 2) / radius_m**2
                if gap < 1.0:
                    total += weights[i, k] * (1.0 - gap)
        scores[h] = total
    return scores

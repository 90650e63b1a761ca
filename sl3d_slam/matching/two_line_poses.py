"""Every pose that lays two source lines on two target lines, and its score; compiled."""

from typing import no_type_check

import numpy as np
from numba import njit

RASTER_CELL_M = 0.5


@njit(cache=True, nogil=True)
@no_type_check
def match_pairs(  # noqa: PLR0913
    source_xy: np.ndarray,
    target_xy: np.ndarray,
    source_pairs: np.ndarray,
    source_m: np.ndarray,
    target_pairs: np.ndarray,
    target_m: np.ndarray,
    tolerance_m: float,
) -> np.ndarray:
    """Return rows of yaw, x, y, and the yaw's cosine and sine.

    Pairs are rows of lines, ascending by their lengths ``source_m`` and ``target_m``.
    """
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


@njit(cache=True, nogil=True)
@no_type_check
def _lie(xy: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Return the angle of each pair's baseline and its middle."""
    found = np.empty((len(pairs), 3))
    for p in range(len(pairs)):
        a, b = xy[pairs[p, 0]], xy[pairs[p, 1]]
        found[p, 0] = np.arctan2(b[1] - a[1], b[0] - a[0])
        found[p, 1], found[p, 2] = 0.5 * (a[0] + b[0]), 0.5 * (a[1] + b[1])
    return found


@njit(cache=True, nogil=True)
@no_type_check
def rasterise(target_xy: np.ndarray, radius_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a grid that names the target line nearest to each cell, -1 where none is near.

    With it comes the grid's corner (2,), metres.
    """
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


@njit(cache=True, nogil=True)
@no_type_check
def score_poses(  # noqa: PLR0913
    poses: np.ndarray,
    source_xy: np.ndarray,
    target_xy: np.ndarray,
    weights: np.ndarray,
    raster: np.ndarray,
    corner: np.ndarray,
    radius_m: float,
) -> np.ndarray:
    """Return the score of each pose: ``weights`` (S, T) of lines that come to lie near another."""
    scores = np.zeros(len(poses))
    x, y = source_xy[:, 0] / RASTER_CELL_M, source_xy[:, 1] / RASTER_CELL_M
    target, reach = (target_xy - corner) / RASTER_CELL_M, (RASTER_CELL_M / radius_m) ** 2
    rows, columns = np.int32(raster.shape[0]), np.int32(raster.shape[1])
    nearest = raster.ravel()
    cell = np.empty(len(x), np.int32)
    for h in range(len(poses)):
        cosine, sine = poses[h, 3], poses[h, 4]
        at_u = (poses[h, 1] - corner[0]) / RASTER_CELL_M
        at_v = (poses[h, 2] - corner[1]) / RASTER_CELL_M
        for i in range(len(x)):  # on its own, so that it runs on several lines at once
            row = np.int32(cosine * x[i] - sine * y[i] + at_u)
            column = np.int32(sine * x[i] + cosine * y[i] + at_v)
            row = max(np.int32(0), min(row, rows - np.int32(1)))
            column = max(np.int32(0), min(column, columns - np.int32(1)))
            cell[i] = row * columns + column
        for i in range(len(x)):
            k = nearest[cell[i]]
            if k >= 0:
                u = cosine * x[i] - sine * y[i] + at_u - target[k, 0]
                v = sine * x[i] + cosine * y[i] + at_v - target[k, 1]
                scores[h] += weights[i, k] * max(1.0 - (u * u + v * v) * reach, 0.0)
    return scores

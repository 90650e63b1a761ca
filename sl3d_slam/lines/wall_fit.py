"""Fits of upright planes seen from above, their extent and their ends; compiled."""

from typing import no_type_check

import numpy as np
from numba import njit

PLANE_SIGMA_M = 0.05
SAME_SHEET_COSINE = 0.95
SLICE_M = 0.3
MAX_END_SPREAD_M = 0.12
END_BAND_M = 0.35


@njit(cache=True, nogil=True)
@no_type_check
def fit_plane(plan: np.ndarray) -> tuple[np.ndarray, float]:
    """Fit a line seen from above to points (N, 2) with weights that ignore what stands off it.

    Returns its unit normal (2,) and ``normal @ xy`` on the line.
    """
    weights = np.ones(len(plan))
    normal, offset = np.zeros(2), 0.0
    for _ in range(4):
        mass = mean_x = mean_y = 0.0
        for i in range(len(plan)):
            mass += weights[i]
            mean_x += weights[i] * plan[i, 0]
            mean_y += weights[i] * plan[i, 1]
        mean_x, mean_y = mean_x / mass, mean_y / mass
        xx = yy = xy = 0.0
        for i in range(len(plan)):
            dx, dy = plan[i, 0] - mean_x, plan[i, 1] - mean_y
            xx += weights[i] * dx * dx
            yy += weights[i] * dy * dy
            xy += weights[i] * dx * dy
        angle = 0.5 * np.arctan2(2.0 * xy, xx - yy)
        normal[0], normal[1] = -np.sin(angle), np.cos(angle)
        offset = normal[0] * mean_x + normal[1] * mean_y
        for i in range(len(plan)):
            off = (normal[0] * plan[i, 0] + normal[1] * plan[i, 1] - offset) / PLANE_SIGMA_M
            weights[i] = 1.0 / (1.0 + off * off) ** 2
    return normal, offset


@njit(cache=True, nogil=True)
@no_type_check
def connected_on_plane(
    points: np.ndarray,
    plane: tuple[np.ndarray, float],
    span: tuple[float, float],
    lengths: tuple[float, float],
) -> tuple[np.ndarray, np.ndarray]:
    """Return which points lie on a plane and hang together with a stretch of it, and where.

    ``span`` is the stretch along ``(normal y, -normal x)``; ``lengths`` are how far off the plane
    counts as on it, and the gap that parts. The positions ascend.
    """
    normal, offset = plane
    off_plane_m, gap_m = lengths
    rows = np.empty(len(points), np.int64)
    count = 0
    for i in range(len(points)):  # written always, kept where on the plane: no branch to miss
        rows[count] = i
        off = points[i, 0] * normal[0] + points[i, 1] * normal[1] - offset
        count += abs(off) < off_plane_m
    rows = rows[:count]
    positions = np.empty(count)
    for k in range(count):
        positions[k] = points[rows[k], 0] * normal[1] - points[rows[k], 1] * normal[0]
    order = np.argsort(positions, kind="mergesort")
    rows, positions = rows[order], positions[order]
    first, stop = np.searchsorted(positions, span[0]), np.searchsorted(positions, span[1])
    while first > 0 and (first == count or positions[first] - positions[first - 1] <= gap_m):
        first -= 1
    stop = max(stop, 1)
    while stop < count and positions[stop] - positions[stop - 1] <= gap_m:
        stop += 1
    return rows[first:stop], positions[first:stop]


@njit(cache=True, nogil=True)
@no_type_check
def straight_end(z: np.ndarray, outward: np.ndarray) -> np.ndarray:
    """Return which points at an end most slices of height agree on; none where they do not.

    ``z`` and ``outward`` (N,) are their heights and how far out they lie, metres.
    """
    low = z.min()
    slices = np.floor((z - low) / SLICE_M).astype(np.int64)
    reach = np.full(slices.max() + 1, -np.inf)
    for i in range(len(z)):
        reach[slices[i]] = max(reach[slices[i]], outward[i])
    seen = reach[np.isfinite(reach)]
    middle = np.median(seen)
    good = np.abs(reach - middle) < MAX_END_SPREAD_M
    agreeing = good.sum()
    if agreeing < 3 or agreeing < 0.6 * len(seen):
        return np.empty(0, np.int64)
    kept = np.empty(len(z), np.int64)
    count = 0
    for i in range(len(z)):
        near = middle - END_BAND_M < outward[i] < middle + MAX_END_SPREAD_M
        kept[count] = i
        count += near and good[slices[i]]
    return kept[:count]


@njit(cache=True, nogil=True)
@no_type_check
def most_alike(normals: np.ndarray, candidates: np.ndarray, min_cosine: float) -> np.ndarray:
    """Return the candidates that face as that one does which most of them face like.

    ``normals`` (N, 2) are unit vectors; at least one candidate is needed.
    """
    best, most = candidates[0], 0
    for i in candidates:
        count = 0
        for j in candidates:
            cosine = normals[i, 0] * normals[j, 0] + normals[i, 1] * normals[j, 1]
            count += abs(cosine) > min_cosine
        if count > most:
            best, most = i, count
    alike = np.empty(most, np.int64)
    count = 0
    for j in candidates:
        cosine = normals[best, 0] * normals[j, 0] + normals[best, 1] * normals[j, 1]
        if abs(cosine) > min_cosine:
            alike[count] = j
            count += 1
    return alike


@njit(cache=True, nogil=True)
@no_type_check
def meeting_of_walls(
    normals: np.ndarray, plan: np.ndarray, min_voxels: int, min_sine: float
) -> np.ndarray:
    """Return where the two sheets of a neighbourhood meet, seen from above (2,); NaN without two.

    ``normals`` and ``plan`` (N, 2) are the horizontal normals and places of its voxels. A sheet has
    ``min_voxels`` at least, and the sine of the angle between both is ``min_sine`` at least.
    """
    nowhere = np.full(2, np.nan)
    if len(plan) < 2 * min_voxels:
        return nowhere
    first = most_alike(normals, np.arange(len(plan)), SAME_SHEET_COSINE)
    lead = normals[first[0]]
    facing = np.abs(normals[:, 0] * lead[0] + normals[:, 1] * lead[1])
    across = np.flatnonzero(facing < np.sqrt(1.0 - min_sine * min_sine))
    if len(first) < min_voxels or len(across) < min_voxels:
        return nowhere
    second = most_alike(normals, across, SAME_SHEET_COSINE)
    if len(second) < min_voxels:
        return nowhere
    n, c = fit_plane(plan[first])
    m, d = fit_plane(plan[second])
    sine = n[0] * m[1] - n[1] * m[0]
    if abs(sine) < min_sine:
        return nowhere
    return np.array([c * m[1] - d * n[1], d * n[0] - c * m[0]]) / sine

"""Local structure of each voxel seen from above, compiled: the per-point scores.

For each voxel two questions are asked of its surroundings in a slab of some height: is it part of
a thin upright sheet (a wall), and is it part of a narrow column with nothing around (a pole)?
"""

from typing import no_type_check

import numpy as np
from numba import njit

CELL_M = 0.25
CORE_RADIUS_M = 0.35
RING_INNER_M = 0.45
RING_OUTER_M = 0.9
SHEET_RADIUS_M = 0.5
BIN_COUNT = 10
MIN_CORE_BINS = 4
MAX_RING_BINS = 3
FAST = {"contract", "nsz", "nnan", "reassoc"}  # sums in any order


@njit(cache=True, nogil=True, fastmath=FAST)
@no_type_check
def local_structure(
    columns: np.ndarray, start: np.ndarray, half_width_m: float, half_height_m: np.ndarray
) -> np.ndarray:
    """Return per point: column bins, ring bins, sheet normal x, y, thickness and width (N, 6).

    ``columns`` (3, N) are the points, sorted by cell, and ``start`` is where each cell begins.
    ``half_height_m`` (N,) is half the height of the slab around each point. Bins are the occupied
    tenths of the slab: in a core of 0.35 m around the local axis, and in the ring from 0.45 to
    0.9 m around it; the ring is not counted beyond 3 bins (then 10 is given), nor looked at for
    columns of fewer than 4. Thickness and width are standard deviations in metres within 0.5 m.
    """
    count = columns.shape[1]
    result = np.zeros((count, 6))
    for i in range(count):
        high = half_height_m[i]
        moments, core = _sheet_moments(columns, start, half_width_m, (i, high))
        n, mx, my = moments[0], moments[1] / moments[0], moments[2] / moments[0]
        xx, yy = moments[3] / n - mx * mx, moments[4] / n - my * my
        xy = moments[5] / n - mx * my
        half_trace, root = 0.5 * (xx + yy), np.sqrt(0.25 * (xx - yy) ** 2 + xy * xy)
        angle = 0.5 * np.arctan2(2 * xy, xx - yy) + 0.5 * np.pi
        result[i, 0], result[i, 1] = _popcount(core[0]), BIN_COUNT
        result[i, 2], result[i, 3] = np.cos(angle), np.sin(angle)
        result[i, 4] = np.sqrt(max(half_trace - root, 0.0))
        result[i, 5] = np.sqrt(half_trace + root)
        if result[i, 0] >= MIN_CORE_BINS:
            axis = (columns[0, i] + core[1], columns[1, i] + core[2], columns[2, i])
            result[i, 0], result[i, 1] = _column_bins(columns, start, half_width_m, (axis, high))
    return result


@njit(cache=True, nogil=True)
@no_type_check
def _popcount(mask: int) -> int:
    count = 0
    while mask:
        mask &= mask - 1
        count += 1
    return count


@njit(cache=True, nogil=True, fastmath=FAST)
@no_type_check
def _sheet_moments(
    columns: np.ndarray, start: np.ndarray, half_width_m: float, query: tuple[int, float]
) -> tuple[tuple[float, float, float, float, float, float], tuple[int, float, float]]:
    """Return the moments (n, x, y, xx, yy, xy) of the surroundings and the core's bins and mean."""
    i, high = query
    x, y, z = columns[0, i], columns[1, i], columns[2, i]
    size, near = int(np.ceil(2 * half_width_m / CELL_M)), int(np.ceil(SHEET_RADIUS_M / CELL_M))
    cx, cy = int((x + half_width_m) / CELL_M), int((y + half_width_m) / CELL_M)
    low, last = max(cy - near, 0), min(cy + near, size - 1)
    n = sx = sy = sxx = syy = sxy = core_n = core_x = core_y = 0.0
    mask = np.int32(0)
    middle, scale = 0.5 * BIN_COUNT, 0.5 * BIN_COUNT / high
    for a in range(max(cx - near, 0), min(cx + near + 1, size)):
        for j in range(start[a * size + low], start[a * size + last + 1]):  # without a branch
            dx, dy, dz = columns[0, j] - x, columns[1, j] - y, columns[2, j] - z
            squared = dx * dx + dy * dy
            level = abs(dz) <= high
            inside = 1.0 if level and squared <= SHEET_RADIUS_M**2 else 0.0
            core = 1.0 if level and squared < CORE_RADIUS_M**2 else 0.0
            n, sx, sy = n + inside, sx + inside * dx, sy + inside * dy
            sxx += inside * dx * dx
            syy += inside * dy * dy
            sxy += inside * dx * dy
            core_n, core_x, core_y = core_n + core, core_x + core * dx, core_y + core * dy
            place = min(max(np.int32(dz * scale + middle), np.int32(0)), np.int32(BIN_COUNT - 1))
            mask |= np.int32(core) << place
    return (n, sx, sy, sxx, syy, sxy), (mask, core_x / core_n, core_y / core_n)


@njit(cache=True, nogil=True, fastmath=FAST)
@no_type_check
def _column_bins(
    columns: np.ndarray,
    start: np.ndarray,
    half_width_m: float,
    query: tuple[tuple[float, float, float], float],
) -> tuple[int, int]:
    """Return the occupied bins of the core and of the ring around a vertical axis."""
    (x, y, z), high = query
    size, reach = int(np.ceil(2 * half_width_m / CELL_M)), int(np.ceil(RING_OUTER_M / CELL_M))
    cx, cy = int((x + half_width_m) / CELL_M), int((y + half_width_m) / CELL_M)
    low, last = max(cy - reach, 0), min(cy + reach, size - 1)
    core = ring = np.int32(0)
    middle, scale = 0.5 * BIN_COUNT, 0.5 * BIN_COUNT / high
    for a in range(max(cx - reach, 0), min(cx + reach + 1, size)):
        for j in range(start[a * size + low], start[a * size + last + 1]):  # without a branch
            dx, dy, dz = columns[0, j] - x, columns[1, j] - y, columns[2, j] - z
            squared = dx * dx + dy * dy
            level = abs(dz) <= high
            place = min(max(np.int32(dz * scale + middle), np.int32(0)), np.int32(BIN_COUNT - 1))
            in_core = level and squared < CORE_RADIUS_M**2
            in_ring = level and RING_INNER_M**2 < squared < RING_OUTER_M**2
            core |= np.int32(in_core) << place
            ring |= np.int32(in_ring) << place
        if _popcount(ring) > MAX_RING_BINS:
            return BIN_COUNT, BIN_COUNT
    return _popcount(core), _popcount(ring)

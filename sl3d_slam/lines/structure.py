"""Local structure of each voxel seen from above, compiled: the per-point scores.

For each voxel two questions are asked of its surroundings in a slab of some height: is it part of
a narrow column with nothing around (a pole), and is it part of a thin upright sheet (a wall)?
"""

import numpy as np
from numba import njit, prange

CELL_M = 0.25
CORE_RADIUS_M = 0.35
RING_INNER_M = 0.45
RING_OUTER_M = 0.9
SHEET_RADIUS_M = 0.5
BIN_COUNT = 10


@njit(cache=True)
def _popcount(mask: int) -> int:
    count = 0
    while mask:
        mask &= mask - 1
        count += 1
    return count


@njit(cache=True, parallel=True)
def local_structure(
    points: np.ndarray,
    order: np.ndarray,
    start: np.ndarray,
    half_width_m: float,
    half_height_m: np.ndarray,
) -> np.ndarray:
    """Return per point: column bins, ring bins, sheet normal x, y, thickness and width (N, 6).

    ``half_height_m`` (N,) is half the height of the slab around each point. Bins are the occupied
    tenths of the slab: in a core of 0.35 m around the local axis and in the ring around it.
    Thickness and width are standard deviations in metres, within 0.5 m horizontally.
    """
    size = int(np.ceil(2 * half_width_m / CELL_M))
    reach = int(np.ceil((RING_OUTER_M + CORE_RADIUS_M) / CELL_M))
    near = int(np.ceil(SHEET_RADIUS_M / CELL_M))
    result = np.zeros((len(points), 6))
    for i in prange(len(points)):
        x, y, z, high = points[i, 0], points[i, 1], points[i, 2], half_height_m[i]
        cx = int((x + half_width_m) / CELL_M)
        cy = int((y + half_width_m) / CELL_M)
        n = sx = sy = sxx = syy = sxy = 0.0
        core_n = core_x = core_y = 0.0
        for a in range(max(cx - near, 0), min(cx + near + 1, size)):
            low, last = max(cy - near, 0), min(cy + near, size - 1)
            for position in range(start[a * size + low], start[a * size + last + 1]):
                j = order[position]
                dx, dy, dz = points[j, 0] - x, points[j, 1] - y, points[j, 2] - z
                squared = dx * dx + dy * dy
                if abs(dz) > high or squared > SHEET_RADIUS_M**2:
                    continue
                n += 1
                sx += dx
                sy += dy
                sxx += dx * dx
                syy += dy * dy
                sxy += dx * dy
                if squared < CORE_RADIUS_M**2:
                    core_n += 1
                    core_x += dx
                    core_y += dy
        mx, my = sx / n, sy / n
        a_, b_, c_ = sxx / n - mx * mx, sxy / n - mx * my, syy / n - my * my
        half_trace, root = 0.5 * (a_ + c_), np.sqrt(0.25 * (a_ - c_) ** 2 + b_ * b_)
        angle = 0.5 * np.arctan2(2 * b_, a_ - c_) + 0.5 * np.pi
        result[i, 2], result[i, 3] = np.cos(angle), np.sin(angle)
        result[i, 4] = np.sqrt(max(half_trace - root, 0.0))
        result[i, 5] = np.sqrt(half_trace + root)
        ax, ay = x + core_x / core_n, y + core_y / core_n
        core_mask = ring_mask = 0
        for a in range(max(cx - reach, 0), min(cx + reach + 1, size)):
            low, last = max(cy - reach, 0), min(cy + reach, size - 1)
            for position in range(start[a * size + low], start[a * size + last + 1]):
                j = order[position]
                dx, dy, dz = points[j, 0] - ax, points[j, 1] - ay, points[j, 2] - z
                squared = dx * dx + dy * dy
                if abs(dz) > high or squared > RING_OUTER_M**2:
                    continue
                bit = 1 << min(int((dz + high) / (2 * high) * BIN_COUNT), BIN_COUNT - 1)
                if squared < CORE_RADIUS_M**2:
                    core_mask |= bit
                elif squared > RING_INNER_M**2:
                    ring_mask |= bit
        result[i, 0] = _popcount(core_mask)
        result[i, 1] = _popcount(ring_mask)
    return result

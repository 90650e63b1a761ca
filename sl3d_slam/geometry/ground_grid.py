"""The ground on a square grid, compiled; see :mod:`sl3d_slam.geometry.ground`.

Grids are square, unknown cells are inf, and a neighbourhood wraps around at the border, where
scans hold next to nothing.
"""

from typing import no_type_check

import numpy as np
from numba import njit

MAX_SLOPE = 0.25
LOW_BAND_M = 0.25
FIRST_SCALE_M, FIT_STEPS = 3.0, 10
STEPS = ((1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, -1), (1, -1), (-1, 1))


@njit(cache=True, nogil=True)
@no_type_check
def lowest_rows(
    points: np.ndarray, ring_m: tuple[float, float], half_width_m: float, cell_m: float
) -> np.ndarray:
    """Return the rows of the lowest point of each occupied cell, ascending; ties all count.

    Only points whose horizontal range lies within ``ring_m`` count.
    """
    size = int(np.ceil(2 * half_width_m / cell_m))
    lowest = np.full(size * size, np.inf)
    rows, key = np.empty(len(points), np.int64), np.empty(len(points), np.int32)
    n = 0
    for i in range(len(points)):
        squared = points[i, 0] ** 2 + points[i, 1] ** 2
        if ring_m[0] ** 2 < squared < ring_m[1] ** 2:
            x = int((points[i, 0] + half_width_m) / cell_m)
            y = int((points[i, 1] + half_width_m) / cell_m)
            rows[n], key[n] = i, x * size + y
            lowest[key[n]] = min(lowest[key[n]], points[i, 2])
            n += 1
    kept = 0
    for k in range(n):
        rows[kept] = rows[k]
        kept += points[rows[k], 2] == lowest[key[k]]
    return rows[:kept]


@njit(cache=True, nogil=True)
@no_type_check
def plane_normal(points: np.ndarray, final_scale_m: float) -> np.ndarray:
    """Return the unit normal, upward, of ``z = a x + b y + c`` fitted with weights that narrow.

    They narrow from 3 m to ``final_scale_m``, and near points count more.
    """
    plane = np.array([0.0, 0.0, np.median(points[:, 2])])
    for step in range(FIT_STEPS):
        scale_m = FIRST_SCALE_M * (final_scale_m / FIRST_SCALE_M) ** (step / (FIT_STEPS - 1))
        H, g = 1e-9 * np.eye(3), np.zeros(3)
        for i in range(len(points)):
            x, y, z = points[i, 0], points[i, 1], points[i, 2]
            off = (z - plane[0] * x - plane[1] * y - plane[2]) / scale_m
            weight = 1.0 / ((5.0 + np.sqrt(x * x + y * y)) * (1.0 + off * off) ** 2)
            row = (x, y, 1.0)
            for a in range(3):
                g[a] += weight * row[a] * z
                for b in range(a + 1):
                    H[a, b] += weight * row[a] * row[b]
        plane = _solve(H, g)
    normal = np.array([-plane[0], -plane[1], 1.0])
    return normal / np.sqrt(plane[0] ** 2 + plane[1] ** 2 + 1.0)


@njit(cache=True)
@no_type_check
def _solve(H: np.ndarray, g: np.ndarray) -> np.ndarray:
    """Solve three symmetric equations by Cholesky's factors; only H's lower half is read."""
    L = np.zeros((3, 3))
    for a in range(3):
        for b in range(a + 1):
            rest = H[a, b]
            for k in range(b):
                rest -= L[a, k] * L[b, k]
            L[a, b] = np.sqrt(rest) if a == b else rest / L[b, b]
    x = g.copy()
    for a in range(3):
        for k in range(a):
            x[a] -= L[a, k] * x[k]
        x[a] /= L[a, a]
    for a in range(2, -1, -1):
        for k in range(a + 1, 3):
            x[a] -= L[k, a] * x[k]
        x[a] /= L[a, a]
    return x


@njit(cache=True, nogil=True)
@no_type_check
def low_grid(level: np.ndarray, half_width_m: float, cell_m: float) -> np.ndarray:
    """Return the mean of each cell's lowest band where two returns are in it; inf elsewhere."""
    size = round(2 * half_width_m / cell_m)
    lowest = np.full((size, size), np.inf)
    for i in range(len(level)):
        x = int(np.floor((level[i, 0] + half_width_m) / cell_m))
        y = int(np.floor((level[i, 1] + half_width_m) / cell_m))
        if 0 <= x < size and 0 <= y < size:
            lowest[x, y] = min(lowest[x, y], level[i, 2])
    count = np.zeros((size, size), np.int64)
    total = np.zeros((size, size))
    for i in range(len(level)):
        x = int(np.floor((level[i, 0] + half_width_m) / cell_m))
        y = int(np.floor((level[i, 1] + half_width_m) / cell_m))
        if 0 <= x < size and 0 <= y < size and level[i, 2] <= lowest[x, y] + LOW_BAND_M:
            count[x, y] += 1
            total[x, y] += level[i, 2]
    for x in range(size):
        for y in range(size):
            total[x, y] = total[x, y] / count[x, y] if count[x, y] >= 2 else np.inf
    return total


@njit(cache=True, nogil=True)
@no_type_check
def without_ghosts(lowest: np.ndarray, cell_m: float) -> np.ndarray:
    """Drop cells that lie in a hole: mirror images seen below the street.

    A cell goes when most of the cells 2 and 4 m away are higher than a slope could make them.
    """
    size = len(lowest)
    result = lowest.copy()
    for x in range(size):
        for y in range(size):
            if lowest[x, y] == np.inf:
                continue
            seen, higher = 0, 0
            for dx in range(-4, 5, 2):
                for dy in range(-4, 5, 2):
                    other = lowest[(x - dx) % size, (y - dy) % size]
                    if (dx != 0 or dy != 0) and other != np.inf:
                        rise = 0.3 + MAX_SLOPE * cell_m * np.hypot(dx, dy)
                        seen += 1
                        higher += other > lowest[x, y] + rise
            if 2 * higher > seen:
                result[x, y] = np.inf
    return result


@njit(cache=True, nogil=True)
@no_type_check
def slope_envelope(lowest: np.ndarray, cell_m: float) -> np.ndarray:
    """Lower the grid to the largest surface below it whose slope is limited."""
    size = len(lowest)
    envelope, before = lowest.copy(), np.empty((size, size))
    for reach in (1, 2, 4):
        for dx, dy in STEPS:
            rise = MAX_SLOPE * cell_m * reach * np.hypot(dx, dy)
            envelope, before = before, envelope
            for x in range(size):
                for y in range(size):
                    moved = before[(x - reach * dx) % size, (y - reach * dy) % size] + rise
                    envelope[x, y] = min(before[x, y], moved)
    return envelope


@njit(cache=True, nogil=True)
@no_type_check
def filled(heights: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Fill unknown cells by means over ever larger windows; smooth the known ones lightly."""
    size = len(heights)
    mass, total = np.zeros((size + 1, size + 1)), np.zeros((size + 1, size + 1))
    for x in range(size):
        row_mass, row_total = 0.0, 0.0
        for y in range(size):
            if known[x, y]:
                row_mass += 1.0
                row_total += heights[x, y]
            mass[x + 1, y + 1] = mass[x, y + 1] + row_mass
            total[x + 1, y + 1] = total[x, y + 1] + row_total
    result = np.zeros((size, size))
    for x in range(size):
        for y in range(size):
            for reach in (1, 3, 7, 15, 31, 63):
                a, b = max(x - reach, 0), min(x + reach + 1, size)
                c, d = max(y - reach, 0), min(y + reach + 1, size)
                inside = mass[b, d] - mass[a, d] - mass[b, c] + mass[a, c]
                if inside > 0.5:
                    sum_m = total[b, d] - total[a, d] - total[b, c] + total[a, c]
                    result[x, y] = sum_m / inside
                    break
    return result


@njit(cache=True, nogil=True)
@no_type_check
def above_grid(
    level: np.ndarray, ground: np.ndarray, half_width_m: float, cell_m: float
) -> np.ndarray:
    """Return the height of each point above the grid, bilinear, the border's values beyond it."""
    last = len(ground) - 1
    heights = np.empty(len(level))
    for i in range(len(level)):
        px = min(max((level[i, 0] + half_width_m) / cell_m - 0.5, 0.0), last - 1e-6)
        py = min(max((level[i, 1] + half_width_m) / cell_m - 0.5, 0.0), last - 1e-6)
        a, b = int(px), int(py)
        x, y = px - a, py - b
        below = ground[a, b] * (1 - y) + ground[a, b + 1] * y
        above = ground[a + 1, b] * (1 - y) + ground[a + 1, b + 1] * y
        heights[i] = level[i, 2] - below * (1 - x) - above * x
    return heights

"""Voxel grid and horizontal cell index, compiled."""

from typing import no_type_check

import numpy as np
from numba import njit


def voxel_means(
    points: np.ndarray, voxel_m: float, min_range_m: float, max_range_m: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Average the points of each occupied voxel, ordered by voxel.

    ``points`` (N, 3 or more) are x, y, z and anything behind, which is averaged, too. Returns the
    means (V, C), how many points each stands for (V,), the points in range sorted by voxel (P, C)
    and where each voxel's points start in them (V + 1,).
    """
    keys, voxel_of, count = _voxels(points, voxel_m, min_range_m, max_range_m)
    order = np.argsort(keys)  # numpy's is several times faster than a compiled one
    return _sorted_by_voxel(points, order, voxel_of, count)


@njit(cache=True, nogil=True)
@no_type_check
def _voxels(
    points: np.ndarray, voxel_m: float, min_range_m: float, max_range_m: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the keys of the occupied voxels, each point's voxel (-1 out of range), and counts."""
    size = 1
    while size < 2 * len(points):
        size *= 2
    table = np.full(size, -1, np.int64)
    keys = np.empty(len(points), np.int64)
    voxel_of = np.full(len(points), -1, np.int64)
    count = np.zeros(len(points), np.int64)
    num_voxels = 0
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        squared = x * x + y * y + z * z
        if squared < min_range_m**2 or squared > max_range_m**2:
            continue
        ix = np.int64(np.floor(x / voxel_m)) + 1_000_000
        iy = np.int64(np.floor(y / voxel_m)) + 1_000_000
        iz = np.int64(np.floor(z / voxel_m)) + 1_000_000
        key = (ix << 42) | (iy << 21) | iz
        slot = (key * 0x9E3779B97F4A7C1 >> 20) & (size - 1)
        while table[slot] >= 0 and keys[table[slot]] != key:
            slot = (slot + 1) & (size - 1)
        if table[slot] < 0:
            table[slot] = num_voxels
            keys[num_voxels] = key
            num_voxels += 1
        voxel_of[i] = table[slot]
        count[table[slot]] += 1
    return keys[:num_voxels], voxel_of, count[:num_voxels]


@njit(cache=True, nogil=True)
@no_type_check
def _sorted_by_voxel(
    points: np.ndarray, order: np.ndarray, voxel_of: np.ndarray, count: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    rank = np.empty(len(count), np.int64)
    start = np.zeros(len(count) + 1, np.int64)
    for position in range(len(order)):
        rank[order[position]] = position
        start[position + 1] = start[position] + count[order[position]]
    columns = points.shape[1]
    members = np.empty((start[-1], columns))
    filled = start[:-1].copy()
    means = np.zeros((len(count), columns))
    for i in range(len(points)):
        if voxel_of[i] < 0:
            continue
        voxel = rank[voxel_of[i]]
        for axis in range(columns):
            members[filled[voxel], axis] = points[i, axis]
            means[voxel, axis] += points[i, axis]
        filled[voxel] += 1
    for voxel in range(len(count)):
        for axis in range(columns):
            means[voxel, axis] /= start[voxel + 1] - start[voxel]
    return means, start[1:] - start[:-1], members, start


@njit(cache=True, nogil=True)
@no_type_check
def cell_index(
    points: np.ndarray, cell_m: float, half_width_m: float
) -> tuple[np.ndarray, np.ndarray]:
    """Sort points into square horizontal cells centred on the sensor.

    Returns the order (N,) that sorts the points by cell, and where each cell starts in it
    (size * size + 1,), cells in row-major order. Points must lie within ``half_width_m``.
    """
    size = int(np.ceil(2 * half_width_m / cell_m))
    start = np.zeros(size * size + 1, np.int64)
    cell_of = np.empty(len(points), np.int64)
    for i in range(len(points)):
        ix = min(max(int((points[i, 0] + half_width_m) / cell_m), 0), size - 1)
        iy = min(max(int((points[i, 1] + half_width_m) / cell_m), 0), size - 1)
        cell_of[i] = ix * size + iy
        start[cell_of[i] + 1] += 1
    for cell in range(size * size):
        start[cell + 1] += start[cell]
    filled = start[:-1].copy()
    order = np.empty(len(points), np.int64)
    for i in range(len(points)):
        order[filled[cell_of[i]]] = i
        filled[cell_of[i]] += 1
    return order, start


@njit(cache=True)
@no_type_check
def rows_in_square(
    start: np.ndarray, half_width_m: float, cell_m: float, place: np.ndarray, radius_m: float
) -> np.ndarray:
    """Return the points in the cells that a square around a place touches.

    ``start`` is :func:`cell_index`'s, of points that are sorted by cell; the square has half side
    ``radius_m``.
    """
    size = int(np.ceil(2 * half_width_m / cell_m))
    low, high = np.empty(2, np.int64), np.empty(2, np.int64)
    for axis in range(2):
        centre = place[axis] + half_width_m
        low[axis] = min(max(int(np.floor((centre - radius_m) / cell_m)), 0), size - 1)
        high[axis] = min(max(int(np.floor((centre + radius_m) / cell_m)), 0), size - 1)
    count = 0
    for row in range(low[0], high[0] + 1):
        count += start[row * size + high[1] + 1] - start[row * size + low[1]]
    rows = np.empty(count, np.int64)
    count = 0
    for row in range(low[0], high[0] + 1):
        for i in range(start[row * size + low[1]], start[row * size + high[1] + 1]):
            rows[count] = i
            count += 1
    return rows


@njit(cache=True)
@no_type_check
def gathered(
    members: np.ndarray, first: np.ndarray, stop: np.ndarray, R_a_b: np.ndarray
) -> np.ndarray:
    """Return the members of some groups, from ``first`` to before ``stop`` each, turned to a."""
    points = np.empty(((stop - first).sum(), 3))
    count = 0
    for group in range(len(first)):
        for i in range(first[group], stop[group]):
            x, y, z = members[i, 0], members[i, 1], members[i, 2]
            for axis in range(3):
                points[count, axis] = R_a_b[axis, 0] * x + R_a_b[axis, 1] * y + R_a_b[axis, 2] * z
            count += 1
    return points

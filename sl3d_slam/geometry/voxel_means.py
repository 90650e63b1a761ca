"""One point for each voxel that a cloud touches, the mean or the first; compiled."""

from typing import no_type_check

import numpy as np
from jaxtyping import Float64
from numba import njit

from sl3d_slam.geometry.se3 import Points
from sl3d_slam.geometry.voxel_table import new_table, slot_of, voxel_key


def voxel_means(points: Points, voxel_m: float, max_range_m: float) -> Float64[np.ndarray, "V 3"]:
    """Return the mean of the points in each voxel, of those nearer than ``max_range_m``.

    Voxels come in the order of x, then y, then z.
    """
    keys, means = _means(points, voxel_m, max_range_m)
    return means[np.argsort(keys)]


def first_in_voxels(points: Points, voxel_m: float) -> Float64[np.ndarray, "V 3"]:
    """Return the first point in each voxel, in the order in which points come."""
    return points[_firsts(points, voxel_m)]


@njit(cache=True, nogil=True)
@no_type_check
def _firsts(points: np.ndarray, voxel_m: float) -> np.ndarray:
    """Return the index of the first point in each voxel."""
    table = new_table(len(points))
    keys, firsts = np.empty(len(points), np.int64), np.empty(len(points), np.int64)
    voxels, last = 0, -1
    for i in range(len(points)):
        key = voxel_key(points[i, 0], points[i, 1], points[i, 2], voxel_m)
        if key == last:  # the next point of a beam, most often
            continue
        last = key
        slot = slot_of(table, keys, key)
        if table[slot] < 0:
            table[slot], keys[voxels], firsts[voxels] = voxels, key, i
            voxels += 1
    return firsts[:voxels]


@njit(cache=True, nogil=True)
@no_type_check
def _means(points: np.ndarray, voxel_m: float, max_range_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a key and the mean of each voxel, in the order in which points touch them."""
    table = new_table(len(points))
    keys, sums = np.empty(len(points), np.int64), np.empty((len(points), 4))
    voxels = 0
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        if not x * x + y * y + z * z < max_range_m * max_range_m:
            continue
        key = voxel_key(x, y, z, voxel_m)
        slot = slot_of(table, keys, key)
        if table[slot] < 0:
            table[slot], keys[voxels] = voxels, key
            sums[voxels] = 0.0
            voxels += 1
        own = table[slot]
        sums[own, 0] += x
        sums[own, 1] += y
        sums[own, 2] += z
        sums[own, 3] += 1.0
    return keys[:voxels], sums[:voxels, :3] / sums[:voxels, 3:]

"""A compiled hash table from voxels to rows; open addressing, at most half full."""

from typing import no_type_check

import numpy as np
from numba import njit

HALF_RANGE = 1 << 20  # voxels along each axis: 21 bits
MULTIPLIER = 0x9E3779B97F4A7C1


@njit(cache=True, nogil=True)
@no_type_check
def voxel_key(x: float, y: float, z: float, voxel_m: float) -> int:
    """Return a number that tells voxels apart, in the order of x, then y, then z."""
    ix = np.int64(np.floor(x / voxel_m)) + HALF_RANGE
    iy = np.int64(np.floor(y / voxel_m)) + HALF_RANGE
    iz = np.int64(np.floor(z / voxel_m)) + HALF_RANGE
    return (ix << 42) | (iy << 21) | iz


@njit(cache=True, nogil=True)
@no_type_check
def new_table(num_rows: int) -> np.ndarray:
    """Return an empty table with room for so many rows; -1 marks a free slot."""
    size = 1
    while size < 2 * num_rows:
        size *= 2
    return np.full(size, -1, np.int32)


@njit(cache=True, nogil=True)
@no_type_check
def slot_of(table: np.ndarray, keys: np.ndarray, key: int) -> int:
    """Return where the row with a key is in the table, or where it belongs.

    ``keys`` are those of the rows, ``table[slot]`` is a row.
    """
    slot = (key * MULTIPLIER >> 20) & (len(table) - 1)
    while table[slot] >= 0 and keys[table[slot]] != key:
        slot = (slot + 1) & (len(table) - 1)
    return slot

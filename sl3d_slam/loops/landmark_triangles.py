"""Compiled: the triangles of every neighbourhood of a map's landmarks, each as one number."""

from typing import no_type_check

import numpy as np
from jaxtyping import Float64, Int32, Int64
from numba import njit

from sl3d_slam.loops.triangles import MAX_SIDE_M, MIN_SIDE_M

ID_BITS = 21
CHUNK = 2048  # neighbourhoods at a time: 24 MB of triangles
SLIVER = 2.03  # times the longest side, the least circumference


def unique_triads(
    xy: Float64[np.ndarray, "L 2"], members: Int32[np.ndarray, "P M"], neighbours: int
) -> Int32[np.ndarray, "T 3"]:
    """Return the triangles of all neighbourhoods, each once, sorted by their lines.

    ``members`` are lines of one neighbourhood a row, -1 after the last; each line makes triangles
    with pairs of its nearest in the row. Rows of the result: opposite the longest side first.
    """
    parts = [np.zeros(0, np.int64)]
    for first in range(0, len(members), CHUNK):
        keys = _triangle_keys(xy, members[first : first + CHUNK], neighbours)
        parts.append(_unique(keys))
    key = _unique(np.concatenate(parts))
    triads = np.empty((len(key), 3), np.int32)
    for corner, shift in enumerate((2 * ID_BITS, ID_BITS, 0)):
        triads[:, corner] = (key >> shift) & ((1 << ID_BITS) - 1)
    return triads


def _unique(keys: Int64[np.ndarray, "N"]) -> Int64[np.ndarray, "U"]:
    """Sort the numbers in place and return each once: numpy's unique hashes, 20 times slower."""
    keys.sort()
    return keys[np.concatenate([[True], keys[1:] != keys[:-1]])] if len(keys) else keys


@njit(cache=True)
@no_type_check
def _triangle_keys(xy: np.ndarray, members: np.ndarray, neighbours: int) -> np.ndarray:
    limit = members.shape[1]
    keys = np.empty(len(members) * limit * (neighbours * (neighbours - 1) // 2), np.int64)
    gaps_m = np.empty((limit, limit))
    near = np.empty((limit, neighbours), np.int32)
    is_near = np.empty((limit, limit), np.bool_)
    n = 0
    for p in range(len(members)):
        count = 0
        while count < limit and members[p, count] >= 0:
            count += 1
        _measure(xy, members[p, :count], gaps_m)
        _find_near(gaps_m, count, near, is_near)
        n = _append(members[p], gaps_m, near[:count], is_near, keys, n)
    return keys[:n].copy()


@njit(cache=True)
@no_type_check
def _measure(xy: np.ndarray, lines: np.ndarray, gaps_m: np.ndarray) -> None:
    for i in range(len(lines)):
        for j in range(i + 1):
            x, y = xy[lines[i], 0] - xy[lines[j], 0], xy[lines[i], 1] - xy[lines[j], 1]
            gaps_m[i, j] = gaps_m[j, i] = np.sqrt(x * x + y * y)


@njit(cache=True)
@no_type_check
def _find_near(gaps_m: np.ndarray, count: int, near: np.ndarray, is_near: np.ndarray) -> None:
    """List the nearest lines of useful distance of each, -1 after the last."""
    is_near[:count, :count] = False
    least_m = np.empty(near.shape[1])
    for i in range(count):
        near[i], least_m[:] = -1, MAX_SIDE_M
        for j in range(count):
            if MIN_SIDE_M <= gaps_m[i, j] < least_m[-1]:
                n = near.shape[1] - 1
                while n > 0 and gaps_m[i, j] < least_m[n - 1]:
                    near[i, n], least_m[n] = near[i, n - 1], least_m[n - 1]
                    n -= 1
                near[i, n], least_m[n] = j, gaps_m[i, j]
        for j in near[i]:
            if j >= 0:
                is_near[i, j] = True


@njit(cache=True)
@no_type_check
def _append(
    lines: np.ndarray,
    gaps_m: np.ndarray,
    near: np.ndarray,
    is_near: np.ndarray,
    keys: np.ndarray,
    n: int,
) -> int:
    """Write each triangle of a neighbourhood once: by the first of its corners that lists both."""
    for i in range(len(near)):
        for a in range(near.shape[1]):
            for b in range(a):
                j, k = near[i, a], near[i, b]
                if j < 0 or not _useful(gaps_m[j, k], gaps_m[i, k], gaps_m[i, j]):
                    continue
                before_j = j < i and is_near[j, i] and is_near[j, k]
                if not before_j and not (k < i and is_near[k, i] and is_near[k, j]):
                    keys[n] = _key(lines, gaps_m, i, j, k)
                    n += 1
    return n


@njit(cache=True)
@no_type_check
def _useful(a: float, b: float, c: float) -> bool:
    longest, shortest = max(a, b, c), min(a, b, c)
    return shortest >= MIN_SIDE_M and longest <= MAX_SIDE_M and a + b + c >= SLIVER * longest


@njit(cache=True)
@no_type_check
def _key(lines: np.ndarray, gaps_m: np.ndarray, i: int, j: int, k: int) -> int:
    """Join the numbers of three lines, the one opposite the longest side first."""
    if gaps_m[j, k] < gaps_m[i, k]:
        i, j = j, i
    if gaps_m[i, k] < gaps_m[i, j]:
        j, k = k, j
    if gaps_m[j, k] < gaps_m[i, k]:
        i, j = j, i
    first, second = np.int64(lines[i]), np.int64(lines[j])
    return (first << (2 * ID_BITS)) | (second << ID_BITS) | np.int64(lines[k])

"""Exact nearest neighbours in a cloud whose points lie about evenly; compiled."""

from typing import no_type_check

import numpy as np
from numba import njit, prange

PIECE = 256
INDEX_BITS = 24
INDEX_MASK = (1 << INDEX_BITS) - 1
LEVELS = 2.0**38
BUCKETS = 128


@njit(cache=True, parallel=True)
@no_type_check
def nearest_of_ranks(
    points: np.ndarray, order: np.ndarray, start: np.ndarray, shape: np.ndarray, ranks: np.ndarray
) -> np.ndarray:
    """Return the neighbours of the given ranks, ascending, of each point (N, 3); 0 is itself.

    ``points`` are from 0 on in every axis, in units of a cell; ``order`` (N,) sorts them by column,
    row-major in a grid of ``shape`` (3,), and ``start`` is where each column begins in it. Equal
    distances (within 2e-6 of a cell) are ranked by index.
    """
    found = np.empty((len(points), len(ranks)), np.int64)
    pieces = (len(points) + PIECE - 1) // PIECE
    for piece in prange(pieces):
        keys, ranked = np.empty(len(points), np.int64), np.empty(len(points), np.int64)
        for place in range(piece * PIECE, min((piece + 1) * PIECE, len(points))):
            i = order[place]
            count = _candidates(points, order, start, shape, (i, ranks[-1] + 1, keys))
            _nearest_first(keys, count, ranks[-1] + 1, ranked)
            for rank in range(len(ranks)):
                found[i, rank] = ranked[ranks[rank]] & INDEX_MASK
    return found


@njit(cache=True)
@no_type_check
def _candidates(
    points: np.ndarray,
    order: np.ndarray,
    start: np.ndarray,
    shape: np.ndarray,
    query: tuple[int, int, np.ndarray],
) -> int:
    """Fill ``keys`` with at least the ``needed`` nearest, as squared distance and index in one."""
    i, needed, keys = query
    cx, cy = int(points[i, 0]), int(points[i, 1])
    size = shape[0] ** 2 + shape[1] ** 2 + shape[2] ** 2
    reach = 1
    while True:
        limit = _inner_reach(points[i], (cx, cy), shape, reach) ** 2
        levels = LEVELS / min(limit, size)
        count = 0
        low, last = max(cy - reach, 0), min(cy + reach, shape[1] - 1)
        for row in range(max(cx - reach, 0), min(cx + reach + 1, shape[0])):
            for place in range(start[row * shape[1] + low], start[row * shape[1] + last + 1]):
                j = order[place]
                dx, dy = points[j, 0] - points[i, 0], points[j, 1] - points[i, 1]
                dz = points[j, 2] - points[i, 2]
                squared = dx * dx + dy * dy + dz * dz
                if squared <= limit:
                    keys[count] = (np.int64(squared * levels) << INDEX_BITS) | j
                    count += 1
        if count >= needed or np.isinf(limit):
            return count
        reach = reach + 1 if reach < 4 else 2 * reach


@njit(cache=True)
@no_type_check
def _nearest_first(keys: np.ndarray, count: int, needed: int, ranked: np.ndarray) -> None:
    """Write at least the ``needed`` smallest keys, ascending, to the front of ``ranked``."""
    shift = _bucket_shift(keys[:count])
    begin = np.zeros(BUCKETS + 1, np.int64)
    for place in range(count):
        begin[(keys[place] >> shift) + 1] += 1
    last = 0
    while last + 1 < BUCKETS and begin[last + 1] < needed:
        last += 1
        begin[last + 1] += begin[last]
    kept = begin[last + 1]
    for place in range(count):
        bucket = keys[place] >> shift
        if bucket <= last:
            ranked[begin[bucket]] = keys[place]
            begin[bucket] += 1
    for place in range(1, kept):  # a bucket's keys lie together already: few steps are left
        key, hole = ranked[place], place
        while hole > 0 and ranked[hole - 1] > key:
            ranked[hole] = ranked[hole - 1]
            hole -= 1
        ranked[hole] = key


@njit(cache=True)
@no_type_check
def _bucket_shift(keys: np.ndarray) -> int:
    largest = 0
    for key in keys:
        largest = max(largest, key)
    shift = 0
    while largest >> shift >= BUCKETS:
        shift += 1
    return shift


@njit(cache=True)
@no_type_check
def _inner_reach(point: np.ndarray, cell: tuple[int, int], shape: np.ndarray, reach: int) -> float:
    """Return the distance within which columns up to ``reach`` away hold all points, or inf."""
    cx, cy = cell
    inside = cx - reach > 0 or cy - reach > 0
    if not (inside or cx + reach < shape[0] - 1 or cy + reach < shape[1] - 1):
        return np.inf
    aside_x = min(point[0] - (cx - reach), cx + reach + 1 - point[0])
    aside_y = min(point[1] - (cy - reach), cy + reach + 1 - point[1])
    return min(aside_x, aside_y)

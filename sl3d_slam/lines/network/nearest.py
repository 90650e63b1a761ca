"""Exact nearest neighbours in a cloud whose points lie about evenly; compiled."""

from typing import no_type_check

import numpy as np
from numba import njit

PIECE = 256
INDEX_BITS = 24
INDEX_MASK = (1 << INDEX_BITS) - 1
LEVEL_BITS = 38
LEVELS = 2.0**LEVEL_BITS
BUCKET_BITS = 7
BUCKETS = 1 << BUCKET_BITS
BUCKET_SHIFT = INDEX_BITS + LEVEL_BITS - BUCKET_BITS


@njit(cache=True, nogil=True)
@no_type_check
def nearest_of_ranks(
    columns: np.ndarray, order: np.ndarray, start: np.ndarray, shape: np.ndarray, ranks: np.ndarray
) -> np.ndarray:
    """Return the neighbours of the given ranks, ascending, of each point; 0 is itself.

    ``columns`` (3, N) are the points from 0 on in every axis, in units of a cell, sorted by column,
    row-major in a grid of ``shape`` (3,); ``order`` (N,) says which point each is, and ``start``
    where each column begins. Equal distances (within 2e-6 of a cell) are ranked by index.
    """
    count = len(order)
    found = np.empty((count, len(ranks)), np.int64)
    pieces = (count + PIECE - 1) // PIECE
    for piece in range(pieces):
        squared = np.empty(count)
        keys, ranked = np.empty(count, np.int64), np.empty(count, np.int64)
        begin = np.empty(BUCKETS + 2, np.int64)
        for place in range(piece * PIECE, min((piece + 1) * PIECE, count)):
            near = _candidates(
                columns, (order, start, shape), (place, ranks[-1] + 1), (squared, keys)
            )
            _nearest_first(keys[:near], ranks[-1] + 1, ranked, begin)
            for rank in range(len(ranks)):
                found[order[place], rank] = ranked[ranks[rank]] & INDEX_MASK
    return found


@njit(cache=True, nogil=True)
@no_type_check
def _candidates(
    columns: np.ndarray,
    grid: tuple[np.ndarray, np.ndarray, np.ndarray],
    query: tuple[int, int],
    buffers: tuple[np.ndarray, np.ndarray],
) -> int:
    """Write at least the ``needed`` nearest to ``keys``, as squared distance and index in one."""
    order, start, shape = grid
    place, needed = query
    squared, keys = buffers
    cx, cy = int(columns[0, place]), int(columns[1, place])
    size = shape[0] ** 2 + shape[1] ** 2 + shape[2] ** 2
    reach = 1
    while True:
        limit = _inner_reach(columns[:, place], (cx, cy), shape, reach) ** 2
        levels = LEVELS / min(limit, size)
        count = 0
        low, last = max(cy - reach, 0), min(cy + reach, shape[1] - 1)
        for row in range(max(cx - reach, 0), min(cx + reach + 1, shape[0])):
            first, stop = start[row * shape[1] + low], start[row * shape[1] + last + 1]
            _squared_distances(columns, place, (first, stop), squared)
            for other in range(first, stop):  # written always, kept where near: no branch to miss
                keys[count] = (np.int64(squared[other - first] * levels) << INDEX_BITS) | order[
                    other
                ]
                count += squared[other - first] <= limit
        if count >= needed or np.isinf(limit):
            return count
        reach = reach + 1 if reach < 4 else 2 * reach


@njit(cache=True, nogil=True, fastmath={"contract"})
@no_type_check
def _squared_distances(
    columns: np.ndarray, place: int, span: tuple[int, int], squared: np.ndarray
) -> None:
    x, y, z = columns[0, place], columns[1, place], columns[2, place]
    for other in range(span[0], span[1]):
        dx, dy, dz = columns[0, other] - x, columns[1, other] - y, columns[2, other] - z
        squared[other - span[0]] = dx * dx + dy * dy + dz * dz


@njit(cache=True, nogil=True)
@no_type_check
def _nearest_first(keys: np.ndarray, needed: int, ranked: np.ndarray, begin: np.ndarray) -> None:
    """Write at least the ``needed`` smallest keys, ascending, to the front of ``ranked``."""
    begin[:] = 0
    for key in keys:
        begin[min(key >> BUCKET_SHIFT, BUCKETS - 1) + 1] += 1
    last = 0
    while last + 1 < BUCKETS and begin[last + 1] < needed:
        last += 1
        begin[last + 1] += begin[last]
    kept = begin[last + 1]
    for key in keys:
        bucket = min(key >> BUCKET_SHIFT, BUCKETS - 1)
        if bucket <= last:
            ranked[begin[bucket]] = key
            begin[bucket] += 1
    for place in range(1, kept):  # a bucket's keys lie together already: few steps are left
        key, hole = ranked[place], place
        while hole > 0 and ranked[hole - 1] > key:
            ranked[hole] = ranked[hole - 1]
            hole -= 1
        ranked[hole] = key


@njit(cache=True, nogil=True)
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

"""Triangles of standing lines: three distances that no change of view alters.

Sides are sorted from long to short, corners named by the side opposite them, and the sense of
rotation (seen from above) is part of the triangle.
"""

from typing import no_type_check

import numpy as np
from jaxtyping import Float64, Int32
from numba import njit

MIN_SIDE_M = 3.0
MAX_SIDE_M = 40.0

Triangles = Int32[np.ndarray, "T 3"]  # rows of the line set: opposite the longest side first


def local_triangles(
    xy: Float64[np.ndarray, "V 2"], neighbours: int, slack_m: float = 0.0
) -> Triangles:
    """Return the triangles of each line with pairs of its nearest lines.

    Each comes once; with a slack in every order that nearly equal sides allow.
    """
    if len(xy) < 3:
        return np.zeros((0, 3), np.int32)
    return _canonical(xy, _local(xy, min(neighbours, len(xy) - 1)), slack_m)


def all_triangles(xy: Float64[np.ndarray, "V 2"], slack_m: float) -> Triangles:
    """Return every triangle of useful size, in every order that nearly equal sides allow."""
    if len(xy) < 3:
        return np.zeros((0, 3), np.int32)
    return _canonical(xy, _all(xy), slack_m)


@njit(cache=True)
@no_type_check
def _local(xy: np.ndarray, neighbours: int) -> np.ndarray:
    count = len(xy)
    seen = np.zeros(count * (count - 1) * (count - 2) // 6, np.bool_)
    rows = np.empty((count * neighbours * (neighbours - 1) // 2, 3), np.int32)
    near = np.empty(neighbours, np.int64)
    n = 0
    for i in range(count):
        num_near = _nearest(xy, i, near)
        for a in range(num_near):
            for b in range(a):
                j, k = near[a], near[b]
                low, high = min(i, j, k), max(i, j, k)
                middle = i + j + k - low - high
                number = high * (high - 1) * (high - 2) // 6 + middle * (middle - 1) // 2 + low
                if not seen[number]:
                    seen[number] = True
                    rows[n, 0], rows[n, 1], rows[n, 2] = i, j, k
                    n += 1
    return rows[:n]


@njit(cache=True)
@no_type_check
def _nearest(xy: np.ndarray, i: int, near: np.ndarray) -> int:
    """Write the points nearest to one, of those a useful side away; return how many there are."""
    gaps = np.empty(len(xy))
    for j in range(len(xy)):
        gaps[j] = np.hypot(xy[j, 0] - xy[i, 0], xy[j, 1] - xy[i, 1])
        if gaps[j] < MIN_SIDE_M:
            gaps[j] = np.inf
    for n in range(len(near)):
        j = np.argmin(gaps)
        if gaps[j] >= MAX_SIDE_M:
            return n
        near[n], gaps[j] = j, np.inf
    return len(near)


@njit(cache=True)
@no_type_check
def _all(xy: np.ndarray) -> np.ndarray:
    count = len(xy)
    rows = np.empty((count * (count - 1) * (count - 2) // 6, 3), np.int32)
    n = 0
    for i in range(count):
        for j in range(i):
            for k in range(j):
                rows[n, 0], rows[n, 1], rows[n, 2] = i, j, k
                n += 1
    return rows


@njit(cache=True)
@no_type_check
def sides_m(xy: np.ndarray, i: int, j: int, k: int) -> tuple[float, float, float]:
    """Return the sides opposite i, j and k."""
    a = np.hypot(xy[j, 0] - xy[k, 0], xy[j, 1] - xy[k, 1])
    b = np.hypot(xy[i, 0] - xy[k, 0], xy[i, 1] - xy[k, 1])
    c = np.hypot(xy[i, 0] - xy[j, 0], xy[i, 1] - xy[j, 1])
    return a, b, c


@njit(cache=True)
@no_type_check
def turns_left(xy: np.ndarray, i: int, j: int, k: int) -> int:
    """Return 1 where i, j, k run anticlockwise, else 0."""
    ux, uy = xy[j, 0] - xy[i, 0], xy[j, 1] - xy[i, 1]
    vx, vy = xy[k, 0] - xy[i, 0], xy[k, 1] - xy[i, 1]
    return 1 if ux * vy - uy * vx > 0 else 0


@njit(cache=True)
@no_type_check
def _canonical(xy: np.ndarray, rows: np.ndarray, slack_m: float) -> np.ndarray:
    """Order corners by their opposite sides, longest first; drop slivers and sizes out of range.

    Sides that differ by less than the slack may swap places in another view, so each order that
    they allow is returned.
    """
    orders = np.array([[0, 1, 2], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]])
    result = np.empty((6 * len(rows), 3), np.int32)
    n = 0
    for r in range(len(rows)):
        a, b, c = sides_m(xy, rows[r, 0], rows[r, 1], rows[r, 2])
        longest, shortest = max(a, b, c), min(a, b, c)
        sliver = a + b + c < 2.03 * longest
        if sliver or shortest < MIN_SIDE_M or longest > MAX_SIDE_M:
            continue
        for order in orders:
            i, j, k = rows[r, order[0]], rows[r, order[1]], rows[r, order[2]]
            a, b, c = sides_m(xy, i, j, k)
            if a >= b - slack_m and b >= c - slack_m:
                result[n, 0], result[n, 1], result[n, 2] = i, j, k
                n += 1
    return result[:n].copy()

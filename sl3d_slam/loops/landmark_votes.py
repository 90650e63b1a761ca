"""Compiled parts of the landmark index: equal triangles, the poses they give, where those agree."""

from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Float64, Int32, Int64, UInt8
from numba import njit

from sl3d_slam.loops.triangles import MAX_SIDE_M, sides_m, turns_left

SIDE_TOLERANCE_M = 0.35
CELL_M = 2 * SIDE_TOLERANCE_M
LEVELS = int(MAX_SIDE_M / CELL_M) + 3
NUM_BUCKETS = 2 * LEVELS**3
CODES = 256  # steps of a side within its cell
NEAR_CODES = CODES * SIDE_TOLERANCE_M / CELL_M
SHIFT_CELL_M = 2.0
NUM_YAWS = 60
YAW_CELL_RAD = 2 * np.pi / NUM_YAWS
CELL_RANGE = 1 << 24  # of shift cells along each axis, enough for 16,000 km either way


class TriangleTable(NamedTuple):
    """Stored triangles, sorted by cells of their sides.

    Attributes
    ----------
    triads : (S, 3) landmark numbers, opposite the longest side first.
    codes : (S, 3) where in its cell each side lies, in 256ths of the cell.
    starts : (NUM_BUCKETS + 1,) where the triangles of each cell begin.
    """

    triads: Int32[np.ndarray, "S 3"]
    codes: UInt8[np.ndarray, "S 3"]
    starts: Int64[np.ndarray, "B"]


def make_table(xy: Float64[np.ndarray, "L 2"], triads: Int32[np.ndarray, "S 3"]) -> TriangleTable:
    """Sort triangles into the table; within a cell they keep their order."""
    return TriangleTable(*_make_table(xy, triads))


def count_equals(
    xy: Float64[np.ndarray, "V 2"], triangles: Int32[np.ndarray, "T 3"], table: TriangleTable
) -> Int64[np.ndarray, "T"]:
    """Return how many stored triangles lie in the cells around each of a query's."""
    return _count_equals(xy, triangles, table.starts)


def lay_on_equals(
    xy: Float64[np.ndarray, "V 2"],
    triangles: Int32[np.ndarray, "T 3"],
    map_xy: Float64[np.ndarray, "L 2"],
    table: TriangleTable,
    limit: int,
) -> Float64[np.ndarray, "P 3"]:
    """Return a planar pose (yaw, x, y) for each stored triangle that equals one of the query's."""
    return _lay_on_equals(xy, triangles, map_xy, table, limit)


def gather_cells(poses: Float64[np.ndarray, "P 3"], num_cells: int) -> Float64[np.ndarray, "C 4"]:
    """Return mean pose and votes around each of the fullest cells of 2 m and 6 degrees."""
    if len(poses) == 0:
        return np.zeros((0, 4))
    size = 1 << int(np.ceil(np.log2(2 * len(poses))))
    keys = np.full(size, -1, np.int64)
    heads, counts = np.full(size, -1, np.int32), np.zeros(size, np.int32)
    links = np.empty(len(poses), np.int32)
    _count_cells(poses, keys, heads, counts, links)
    used = np.flatnonzero(counts)
    fullest = used[np.argsort(-counts[used], kind="stable")[:num_cells]]
    return _gather(poses, keys, heads, links, fullest)


@njit(cache=True)
@no_type_check
def _bucket(i: int, j: int, k: int, left: int) -> int:
    return ((i * LEVELS + j) * LEVELS + k) * 2 + left


@njit(cache=True)
@no_type_check
def _cells(xy: np.ndarray, i: int, j: int, k: int) -> tuple[float, float, float]:
    """Return the sides of a triangle in cells."""
    a, b, c = sides_m(xy, i, j, k)
    return a / CELL_M, b / CELL_M, c / CELL_M


@njit(cache=True)
@no_type_check
def _make_table(xy: np.ndarray, triads: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    buckets = np.empty(len(triads), np.int32)
    starts = np.zeros(NUM_BUCKETS + 1, np.int64)
    for t in range(len(triads)):
        i, j, k = triads[t, 0], triads[t, 1], triads[t, 2]
        a, b, c = _cells(xy, i, j, k)
        buckets[t] = _bucket(int(a), int(b), int(c), turns_left(xy, i, j, k))
        starts[buckets[t] + 1] += 1
    starts = np.cumsum(starts)
    ends = starts[:-1].copy()
    rows, codes = np.empty((len(triads), 3), np.int32), np.empty((len(triads), 3), np.uint8)
    for t in range(len(triads)):
        row = ends[buckets[t]]
        ends[buckets[t]] += 1
        rows[row] = triads[t]
        a, b, c = _cells(xy, triads[t, 0], triads[t, 1], triads[t, 2])
        codes[row, 0] = int((a - int(a)) * CODES)
        codes[row, 1] = int((b - int(b)) * CODES)
        codes[row, 2] = int((c - int(c)) * CODES)
    return rows, codes, starts


@njit(cache=True)
@no_type_check
def _count_equals(xy: np.ndarray, triangles: np.ndarray, starts: np.ndarray) -> np.ndarray:
    counts = np.zeros(len(triangles), np.int64)
    for t in range(len(triangles)):
        i, j, k = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        a, b, c = _cells(xy, i, j, k)
        low = _bucket(int(a - 0.5), int(b - 0.5), int(c - 0.5), turns_left(xy, i, j, k))
        for s in range(8):
            cell = low + _bucket(s & 1, (s >> 1) & 1, s >> 2, 0)
            counts[t] += starts[cell + 1] - starts[cell]
    return counts


@njit(cache=True)
@no_type_check
def _lay_on_equals(
    xy: np.ndarray,
    triangles: np.ndarray,
    map_xy: np.ndarray,
    table: TriangleTable,
    limit: int,
) -> np.ndarray:
    """Compare codes first; the few triangles that pass are looked up."""
    triads, codes, starts = table
    poses = np.empty((limit, 3))
    n = 0
    for t in range(len(triangles)):
        i, j, k = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        a, b, c = _cells(xy, i, j, k)
        u, v, w = int(a - 0.5), int(b - 0.5), int(c - 0.5)
        low = _bucket(u, v, w, turns_left(xy, i, j, k))
        for s in range(8):
            du, dv, dw = s & 1, (s >> 1) & 1, s >> 2
            cell = low + _bucket(du, dv, dw, 0)
            first = (a - u - du) * CODES - 0.5
            second = (b - v - dv) * CODES - 0.5
            third = (c - w - dw) * CODES - 0.5
            for entry in range(starts[cell], starts[cell + 1]):
                if (
                    abs(first - codes[entry, 0]) < NEAR_CODES
                    and abs(second - codes[entry, 1]) < NEAR_CODES
                    and abs(third - codes[entry, 2]) < NEAR_CODES
                    and n < limit
                ):
                    _lay_on(xy, triangles[t], map_xy, triads[entry], poses[n])
                    n += 1
    return poses[:n].copy()


@njit(cache=True)
@no_type_check
def _lay_on(
    xy: np.ndarray, triangle: np.ndarray, map_xy: np.ndarray, triad: np.ndarray, pose: np.ndarray
) -> None:
    """Write the planar pose that lays one triangle on the other, least squares."""
    qx, qy, sx, sy = 0.0, 0.0, 0.0, 0.0
    for v in range(3):
        qx += xy[triangle[v], 0] / 3.0
        qy += xy[triangle[v], 1] / 3.0
        sx += map_xy[triad[v], 0] / 3.0
        sy += map_xy[triad[v], 1] / 3.0
    dot, cross = 0.0, 0.0
    for v in range(3):
        ax, ay = xy[triangle[v], 0] - qx, xy[triangle[v], 1] - qy
        bx, by = map_xy[triad[v], 0] - sx, map_xy[triad[v], 1] - sy
        dot += ax * bx + ay * by
        cross += ax * by - ay * bx
    pose[0] = np.arctan2(cross, dot)
    length = max(np.sqrt(dot * dot + cross * cross), 1e-12)
    cosine, sine = dot / length, cross / length
    pose[1] = sx - (cosine * qx - sine * qy)
    pose[2] = sy - (sine * qx + cosine * qy)


@njit(cache=True)
@no_type_check
def _key(turn: int, i: int, j: int) -> int:
    return ((turn % NUM_YAWS) * CELL_RANGE + i + CELL_RANGE // 2) * CELL_RANGE + j + CELL_RANGE // 2


@njit(cache=True)
@no_type_check
def _slot(keys: np.ndarray, key: int) -> int:
    """Return where a cell is in the table, or where it would go."""
    mixed = key ^ (key >> 29)
    mixed = (mixed * 0x2545F4914F6CDD1D) & 0x7FFFFFFFFFFFFFFF
    slot = (mixed ^ (mixed >> 32)) & (len(keys) - 1)
    while keys[slot] >= 0 and keys[slot] != key:
        slot = (slot + 1) & (len(keys) - 1)
    return slot


@njit(cache=True)
@no_type_check
def _count_cells(
    poses: np.ndarray, keys: np.ndarray, heads: np.ndarray, counts: np.ndarray, links: np.ndarray
) -> None:
    for p in range(len(poses)):
        turn = int(np.floor(poses[p, 0] / YAW_CELL_RAD))
        i = int(np.floor(poses[p, 1] / SHIFT_CELL_M))
        j = int(np.floor(poses[p, 2] / SHIFT_CELL_M))
        key = _key(turn, i, j)
        slot = _slot(keys, key)
        keys[slot] = key
        links[p] = heads[slot]
        heads[slot] = p
        counts[slot] += 1


@njit(cache=True)
@no_type_check
def _gather(
    poses: np.ndarray, keys: np.ndarray, heads: np.ndarray, links: np.ndarray, slots: np.ndarray
) -> np.ndarray:
    """Move from one vote of each cell to the mean of those around it, twice."""
    result = np.empty((len(slots), 4))
    for s in range(len(slots)):
        result[s, :3] = poses[heads[slots[s]]]
        for _ in range(2):
            _mean_around(poses, keys, heads, links, result[s])
    return result


@njit(cache=True)
@no_type_check
def _mean_around(
    poses: np.ndarray, keys: np.ndarray, heads: np.ndarray, links: np.ndarray, at: np.ndarray
) -> None:
    turn = int(np.floor(at[0] / YAW_CELL_RAD))
    i, j = int(np.floor(at[1] / SHIFT_CELL_M)), int(np.floor(at[2] / SHIFT_CELL_M))
    yaws, xs, ys, count = 0.0, 0.0, 0.0, 0
    for cell in range(27):
        key = _key(turn + cell // 9 - 1, i + cell // 3 % 3 - 1, j + cell % 3 - 1)
        p = heads[_slot(keys, key)]
        while p >= 0:
            gap = (poses[p, 0] - at[0] + np.pi) % (2.0 * np.pi) - np.pi
            shift = (poses[p, 1] - at[1]) ** 2 + (poses[p, 2] - at[2]) ** 2
            if abs(gap) < YAW_CELL_RAD and shift < SHIFT_CELL_M**2:
                yaws += gap
                xs += poses[p, 1]
                ys += poses[p, 2]
                count += 1
            p = links[p]
    if count > 0:
        at[0] += yaws / count
        at[1], at[2] = xs / count, ys / count
    at[3] = count

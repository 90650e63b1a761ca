"""Compiled parts of the landmark index: equal triangles, the poses they give, where those agree."""

from typing import no_type_check

import numpy as np
from jaxtyping import Float64, Int32, Int64
from numba import njit

from sl3d_slam.loops.triangles import MAX_SIDE_M, sides_m, turns_left

SIDE_TOLERANCE_M = 0.35
CELL_M = 2 * SIDE_TOLERANCE_M
LEVELS = int(MAX_SIDE_M / CELL_M) + 3
NUM_BUCKETS = 2 * LEVELS**3
SHIFT_CELL_M = 2.0
NUM_YAWS = 60
YAW_CELL_RAD = 2 * np.pi / NUM_YAWS
CELL_RANGE = 1 << 24  # of shift cells along each axis, enough for 16,000 km either way


def buckets_of(
    xy: Float64[np.ndarray, "L 2"], triads: Int32[np.ndarray, "T 3"]
) -> Int64[np.ndarray, "T"]:
    """Return the table's cell of each triangle."""
    return _buckets_of(xy, triads)


def count_equals(
    xy: Float64[np.ndarray, "V 2"],
    triangles: Int32[np.ndarray, "T 3"],
    starts: Int64[np.ndarray, "B"],
) -> Int64[np.ndarray, "T"]:
    """Return how many stored triangles lie in the cells around each of a query's."""
    return _count_equals(xy, triangles, starts)


def lay_on_equals(
    xy: Float64[np.ndarray, "V 2"],
    triangles: Int32[np.ndarray, "T 3"],
    map_xy: Float64[np.ndarray, "L 2"],
    triads: Int32[np.ndarray, "S 3"],
    starts: Int64[np.ndarray, "B"],
    limit: int,
) -> Float64[np.ndarray, "P 3"]:
    """Return a planar pose (yaw, x, y) for each stored triangle that equals one of the query's."""
    return _lay_on_equals(xy, triangles, map_xy, triads, starts, limit)


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
def _buckets_of(xy: np.ndarray, triads: np.ndarray) -> np.ndarray:
    result = np.empty(len(triads), np.int64)
    for t in range(len(triads)):
        i, j, k = triads[t, 0], triads[t, 1], triads[t, 2]
        a, b, c = sides_m(xy, i, j, k)
        left = turns_left(xy, i, j, k)
        result[t] = _bucket(int(a / CELL_M), int(b / CELL_M), int(c / CELL_M), left)
    return result


@njit(cache=True)
@no_type_check
def _around(xy: np.ndarray, i: int, j: int, k: int, cells: np.ndarray) -> None:
    """Name the 8 cells that touch the cube of the tolerance around a triangle's sides."""
    sides = sides_m(xy, i, j, k)
    left = turns_left(xy, i, j, k)
    low = np.empty(3, np.int64)
    for axis in range(3):
        low[axis] = int(np.floor(sides[axis] / CELL_M - 0.5))
    for s in range(8):
        cells[s] = _bucket(low[0] + (s & 1), low[1] + ((s >> 1) & 1), low[2] + (s >> 2), left)


@njit(cache=True)
@no_type_check
def _count_equals(xy: np.ndarray, triangles: np.ndarray, starts: np.ndarray) -> np.ndarray:
    counts = np.zeros(len(triangles), np.int64)
    cells = np.empty(8, np.int64)
    for t in range(len(triangles)):
        _around(xy, triangles[t, 0], triangles[t, 1], triangles[t, 2], cells)
        for s in range(8):
            counts[t] += starts[cells[s] + 1] - starts[cells[s]]
    return counts


@njit(cache=True)
@no_type_check
def _lay_on_equals(
    xy: np.ndarray,
    triangles: np.ndarray,
    map_xy: np.ndarray,
    triads: np.ndarray,
    starts: np.ndarray,
    limit: int,
) -> np.ndarray:
    poses = np.empty((limit, 3))
    cells = np.empty(8, np.int64)
    n = 0
    for t in range(len(triangles)):
        _around(xy, triangles[t, 0], triangles[t, 1], triangles[t, 2], cells)
        a, b, c = sides_m(xy, triangles[t, 0], triangles[t, 1], triangles[t, 2])
        for s in range(8):
            for entry in range(starts[cells[s]], starts[cells[s] + 1]):
                triad = triads[entry]
                d, e, f = sides_m(map_xy, triad[0], triad[1], triad[2])
                if max(abs(a - d), abs(b - e), abs(c - f)) < SIDE_TOLERANCE_M and n < limit:
                    _lay_on(xy, triangles[t], map_xy, triad, poses[n])
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
    cosine, sine = np.cos(pose[0]), np.sin(pose[0])
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

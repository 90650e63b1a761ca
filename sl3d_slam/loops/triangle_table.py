"""Where have I seen this triangle before? A table of triangles by their sides, compiled.

A cell of the table holds the triangles of one sense whose sides fall into one cube of half a metre,
in blocks of eight that lie together in memory: looking through a full cell costs no more than a few
reads, which matters once a town has half a million triangles.
"""

from pathlib import Path
from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Float32, Float64, Int32, UInt8
from numba import njit

from sl3d_slam.loops.triangles import MAX_SIDE_M, Triangles, sides_m, turns_left

CELL_M = 0.5
CELLS = int(MAX_SIDE_M / CELL_M) + 1
BLOCK = 8


class Blocks(NamedTuple):
    """The triangles, in blocks; the first ``counts`` of a block are filled.

    ``heads`` (cells) and ``links`` name the newest block of a cell and the one before it, -1 where
    there is none; ``sides_m``, ``owners`` and ``corners`` are those of each triangle.
    """

    heads: Int32[np.ndarray, "H"]
    links: Int32[np.ndarray, "B"]
    counts: UInt8[np.ndarray, "B"]
    sides_m: Float32[np.ndarray, "B T 3"]
    owners: Int32[np.ndarray, "B T"]
    corners: UInt8[np.ndarray, "B T 3"]


class TriangleTable:
    """Triangles of point sets, each set known by a number, its owner."""

    def __init__(self) -> None:
        self._num_blocks = 0
        self._num_triangles = 0
        self._blocks = Blocks(
            heads=np.full(2 * CELLS**3, -1, np.int32),
            links=np.empty(0, np.int32),
            counts=np.empty(0, np.uint8),
            sides_m=np.empty((0, BLOCK, 3), np.float32),
            owners=np.empty((0, BLOCK), np.int32),
            corners=np.empty((0, BLOCK, 3), np.uint8),
        )

    def __len__(self) -> int:
        """Return the number of triangles."""
        return self._num_triangles

    def add(self, owner: int, xy: Float32[np.ndarray, "V 2"], triangles: Triangles) -> None:
        """Store triangles of at most 256 points."""
        heads, *rest = self._blocks
        rest = [with_room(array, self._num_blocks + len(triangles)) for array in rest]
        self._blocks = Blocks(heads, *rest)
        self._num_blocks = _add(self._blocks, self._num_blocks, owner, xy, triangles)
        self._num_triangles += len(triangles)

    def alike(
        self,
        xy: Float64[np.ndarray, "V 2"],
        triangles: Triangles,
        num_owners: int,
        slack_m: float,
        limit: int,
    ) -> tuple[Int32[np.ndarray, "M"], Int32[np.ndarray, "M"], UInt8[np.ndarray, "M 3"]]:
        """Return pairs of triangles whose sides differ by less than a slack, at most ``limit``.

        Of each pair the row in ``triangles``, the owner (below ``num_owners``) of the stored one
        and its corners, in the order that lays them on the row's.
        """
        return _alike(self._blocks, xy, triangles, num_owners, slack_m, limit)


def must_compile() -> bool:
    """Tell whether looking for what is alike has neither run in this process nor been kept."""
    return not _alike.signatures and not any(
        Path(_alike.stats.cache_path).glob(f"*.{_alike.py_func.__name__}-*.nbi")
    )


def with_room(array: np.ndarray, count: int) -> np.ndarray:
    """Return the array, or a copy with room for at least so many rows; fresh rows hold anything."""
    if count <= len(array):
        return array
    grown = np.empty((max(count, len(array) + len(array) // 2, 64), *array.shape[1:]), array.dtype)
    grown[: len(array)] = array
    return grown


@njit(cache=True)
@no_type_check
def _add(blocks: Blocks, num_blocks: int, owner: int, xy: np.ndarray, triangles: np.ndarray) -> int:
    """Store triangles; return the number of blocks that are then in use."""
    for t in range(len(triangles)):
        i, j, k = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        a, b, c = sides_m(xy, i, j, k)
        cell = _cell(int(a / CELL_M), int(b / CELL_M), int(c / CELL_M), turns_left(xy, i, j, k))
        block = blocks.heads[cell]
        if block < 0 or blocks.counts[block] == BLOCK:
            blocks.links[num_blocks] = block
            blocks.counts[num_blocks] = 0
            blocks.heads[cell] = block = num_blocks
            num_blocks += 1
        place = blocks.counts[block]
        blocks.counts[block] += 1
        blocks.owners[block, place] = owner
        blocks.sides_m[block, place, 0] = a
        blocks.sides_m[block, place, 1] = b
        blocks.sides_m[block, place, 2] = c
        blocks.corners[block, place, 0] = i
        blocks.corners[block, place, 1] = j
        blocks.corners[block, place, 2] = k
    return num_blocks


@njit(cache=True)
@no_type_check
def _cell(i: int, j: int, k: int, left: int) -> int:
    return ((i * CELLS + j) * CELLS + k) * 2 + left


@njit(cache=True)
@no_type_check
def _alike(
    blocks: Blocks,
    xy: np.ndarray,
    triangles: np.ndarray,
    num_owners: int,
    slack_m: float,
    limit: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rows, owners = np.empty(limit, np.int32), np.empty(limit, np.int32)
    corners = np.empty((limit, 3), np.uint8)
    n, cells = 0, np.empty(27, np.int64)
    for t in range(len(triangles)):
        a, b, c = sides_m(xy, triangles[t, 0], triangles[t, 1], triangles[t, 2])
        left = turns_left(xy, triangles[t, 0], triangles[t, 1], triangles[t, 2])
        for s in range(_cells_around(a, b, c, left, slack_m, cells)):
            block = blocks.heads[cells[s]]
            while block >= 0:
                for p in range(blocks.counts[block]):
                    stored, owner = blocks.sides_m[block, p], blocks.owners[block, p]
                    near = abs(a - stored[0]) < slack_m and abs(b - stored[1]) < slack_m
                    near = near and abs(c - stored[2]) < slack_m
                    if near and owner < num_owners and n < limit:
                        rows[n], owners[n] = t, owner
                        corners[n] = blocks.corners[block, p]
                        n += 1
                block = blocks.links[block]
    return rows[:n], owners[:n], corners[:n]


@njit(cache=True)
@no_type_check
def _cells_around(
    a: float, b: float, c: float, left: int, slack_m: float, cells: np.ndarray
) -> int:
    """Write the cells that hold what differs by at most a slack below half a metre; count them."""
    (low_a, high_a), (low_b, high_b) = _span(a, slack_m), _span(b, slack_m)
    low_c, high_c = _span(c, slack_m)
    n = 0
    for i in range(low_a, high_a + 1):
        for j in range(low_b, high_b + 1):
            for k in range(low_c, high_c + 1):
                cells[n] = _cell(i, j, k, left)
                n += 1
    return n


@njit(cache=True)
@no_type_check
def _span(side_m: float, slack_m: float) -> tuple[int, int]:
    """Return the first and the last cell, along one axis, of the sides around one."""
    last = CELLS - 1
    return max(int((side_m - slack_m) / CELL_M), 0), min(int((side_m + slack_m) / CELL_M), last)

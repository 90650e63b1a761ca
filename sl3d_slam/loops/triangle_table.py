"""Where have I seen this triangle before? A table of triangles by their sides, compiled.

A cell of the table holds the triangles of one sense whose sides fall into one cube of half a metre,
in blocks of eight. What is looked at of a block, the sides and where the next block is, is 64 bytes
long, one line of a processor's cache: with half a million triangles the table is far larger than
the cache, and fetching it from memory is what takes the time.
"""

from pathlib import Path
from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Float32, Float64, Int32, Int64, UInt16
from numba import njit

from sl3d_slam.loops.triangles import MAX_SIDE_M, Triangles, sides_m, turns_left

CELL_M = 0.5
CELLS = int(MAX_SIDE_M / CELL_M) + 1
BLOCK = 8
UNITS_PER_M = 1024.0  # sides are kept in whole units
MOST = 64  # points of one owner
COUNT, NEXT, LINE = 24, 25, 32  # in a line: after 8 times 3 sides, their number and the next block


class Blocks(NamedTuple):
    """The triangles, in blocks numbered from 1.

    ``heads`` name the newest block of every cell, 0 where there is none. A line holds the sides of
    a block's triangles in units, how many they are, and the number of the block before it in two
    parts. ``names`` tell of each triangle its owner and its corners, see :func:`owner_of`.
    """

    heads: Int32[np.ndarray, "H"]
    lines: UInt16[np.ndarray, "B 32"]
    names: Int64[np.ndarray, "B T"]


class TriangleTable:
    """Triangles of point sets, each set known by a number, its owner."""

    def __init__(self) -> None:
        self._num_blocks = 1  # the first is never used
        self._num_triangles = 0
        self._blocks = Blocks(
            heads=np.zeros(2 * CELLS**3, np.int32),
            lines=np.empty((0, LINE), np.uint16),
            names=np.empty((0, BLOCK), np.int64),
        )

    def __len__(self) -> int:
        """Return the number of triangles."""
        return self._num_triangles

    def add(self, owner: int, xy: Float32[np.ndarray, "V 2"], triangles: Triangles) -> None:
        """Store triangles of at most 64 points."""
        heads, lines, names = self._blocks
        needed = self._num_blocks + len(triangles)
        self._blocks = Blocks(heads, with_room(lines, needed), with_room(names, needed))
        self._num_blocks = _add(self._blocks, self._num_blocks, owner, xy, triangles)
        self._num_triangles += len(triangles)

    def alike(
        self,
        xy: Float64[np.ndarray, "V 2"],
        triangles: Triangles,
        num_owners: int,
        slack_m: float,
        limit: int,
    ) -> tuple[Int32[np.ndarray, "M"], Int64[np.ndarray, "M"]]:
        """Return pairs of triangles whose sides differ by less than a slack, at most ``limit``.

        Of each pair the row in ``triangles``, and the name of the stored one, whose corners have
        the order that lays them on the row's; owners are below ``num_owners``. The slack is below
        half a metre and holds to a millimetre.
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
        if block == 0 or blocks.lines[block, COUNT] == BLOCK:
            line = blocks.lines[num_blocks]
            line[COUNT], line[NEXT], line[NEXT + 1] = 0, block & 0xFFFF, block >> 16
            blocks.heads[cell] = block = num_blocks
            num_blocks += 1
        line = blocks.lines[block]
        place = np.int64(line[COUNT])
        line[COUNT] += 1
        line[3 * place], line[3 * place + 1], line[3 * place + 2] = _units(a), _units(b), _units(c)
        blocks.names[block, place] = ((owner * MOST + i) * MOST + j) * MOST + k
    return num_blocks


@njit(cache=True)
@no_type_check
def owner_of(name: int) -> int:
    """Return the owner of a stored triangle."""
    return name // MOST**3


@njit(cache=True)
@no_type_check
def corners_of(name: int) -> tuple[int, int, int]:
    """Return the corners of a stored triangle, rows of its owner's points."""
    return name // MOST**2 % MOST, name // MOST % MOST, name % MOST


@njit(cache=True)
@no_type_check
def _units(side_m: float) -> int:
    return int(side_m * UNITS_PER_M + 0.5)


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
) -> tuple[np.ndarray, np.ndarray]:
    rows, names = np.empty(limit, np.int32), np.empty(limit, np.int64)
    n, cells, slack = 0, np.empty(27, np.int64), _units(slack_m)
    for t in range(len(triangles)):
        sides = sides_m(xy, triangles[t, 0], triangles[t, 1], triangles[t, 2])
        left = turns_left(xy, triangles[t, 0], triangles[t, 1], triangles[t, 2])
        a, b, c = _units(sides[0]), _units(sides[1]), _units(sides[2])
        for s in range(_cells_around(sides, left, slack_m, cells)):
            block = blocks.heads[cells[s]]
            while block > 0:
                line = blocks.lines[block]
                for p in range(np.int64(line[COUNT])):
                    gap = abs(a - np.int64(line[3 * p]))
                    gap = max(gap, abs(b - np.int64(line[3 * p + 1])))
                    gap = max(gap, abs(c - np.int64(line[3 * p + 2])))
                    if gap < slack and owner_of(blocks.names[block, p]) < num_owners and n < limit:
                        rows[n], names[n] = t, blocks.names[block, p]
                        n += 1
                block = np.int64(line[NEXT]) | np.int64(line[NEXT + 1]) << 16
    return rows[:n], names[:n]


@njit(cache=True)
@no_type_check
def _cells_around(
    sides: tuple[float, float, float], left: int, slack_m: float, cells: np.ndarray
) -> int:
    """Write the cells that hold what differs by at most a slack below half a metre; count them."""
    (low_a, high_a), (low_b, high_b) = _span(sides[0], slack_m), _span(sides[1], slack_m)
    low_c, high_c = _span(sides[2], slack_m)
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

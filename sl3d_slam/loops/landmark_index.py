"""Poses in a whole map by constellation, in a time that does not grow with the map.

Every triangle of neighbouring landmarks is stored once, in the map's own frame, in one table sorted
by its sides. A query lays its triangles on equal ones, those of neighbours first, among them those
with the fewest equals, and only as many as a fixed budget of comparisons allows: in a larger map
each triangle has more equals, so fewer are tried, but a wrong vote finds ever more room to be alone
in, and a true one never is.
"""

import numpy as np
from jaxtyping import Bool, Float64, Int32

from sl3d_slam.loops.landmark_triangles import ID_BITS, unique_triads
from sl3d_slam.loops.landmark_votes import (
    SIDE_TOLERANCE_M,
    TriangleTable,
    count_equals,
    gather_cells,
    lay_on_equals,
    make_table,
)
from sl3d_slam.loops.triangles import MIN_SIDE_M, all_triangles

NEIGHBOURS = 9
QUERY_NEIGHBOURS = 12  # a scan sees some lines that a map lacks
MAX_LINES = 40
# in a million lines 43 of 44 scans of another day keep their true pose among the guesses; a
# third of the comparisons keeps 40
MAX_COMPARISONS = 2_400_000
MAX_VOTES = 400_000
NUM_CELLS = 160


class LandmarkIndex:
    """The triangles of a map's standing lines, by their sides."""

    def __init__(self, xy: Float64[np.ndarray, "L 2"], members: Int32[np.ndarray, "P M"]) -> None:
        """Index lines seen from above, metres in one level frame of the map.

        ``members`` are lines that one sensor sees together, a row each, strongest first, -1 after
        the last; each row gives the triangles of its first 40 with their near neighbours.
        """
        if len(xy) >= 1 << ID_BITS:
            raise ValueError(f"a map of more than {(1 << ID_BITS) - 1} standing lines")
        self._xy = np.ascontiguousarray(xy, np.float64)
        triads = unique_triads(self._xy, members[:, :MAX_LINES], NEIGHBOURS)
        self._table: TriangleTable = make_table(self._xy, triads)

    def __len__(self) -> int:
        """Return the number of stored triangles."""
        return len(self._table.triads)

    def query(
        self, xy: Float64[np.ndarray, "V 2"], weights: Float64[np.ndarray, "V"], limit: int
    ) -> Float64[np.ndarray, "K 4"]:
        """Return the best-voted planar poses of a scan, rows of yaw_rad, x_m, y_m and votes.

        ``xy`` are the scan's standing lines in its level frame; the poses are in the level frame
        of the map, best first, at most ``limit``. Neighbouring cells may give the same pose twice.
        """
        xy = np.ascontiguousarray(xy[np.argsort(-weights, kind="stable")[:MAX_LINES]])
        triangles = all_triangles(xy, SIDE_TOLERANCE_M)
        counts = count_equals(xy, triangles, self._table)
        order = np.lexsort((counts, ~_are_of_neighbours(xy, triangles)))
        affordable = np.searchsorted(np.cumsum(counts[order]), MAX_COMPARISONS, side="right")
        chosen = triangles[order[:affordable]]
        votes = lay_on_equals(xy, chosen, self._xy, self._table, MAX_VOTES)
        cells = gather_cells(votes, min(NUM_CELLS, 4 * limit))
        return cells[np.argsort(-cells[:, 3], kind="stable")[:limit]]


def _are_of_neighbours(
    xy: Float64[np.ndarray, "V 2"], triangles: Int32[np.ndarray, "T 3"]
) -> Bool[np.ndarray, "T"]:
    """Tell which triangles are a line with two of its nearest: the kind that a map stores."""
    gaps_m = np.linalg.norm(xy[:, None] - xy[None], axis=2)
    gaps_m[gaps_m < MIN_SIDE_M] = np.inf
    rank = np.argsort(np.argsort(gaps_m, axis=1, kind="stable"), axis=1, kind="stable")
    near = rank < QUERY_NEIGHBOURS
    i, j, k = triangles.T
    return (near[i, j] & near[i, k]) | (near[j, i] & near[j, k]) | (near[k, i] & near[k, j])

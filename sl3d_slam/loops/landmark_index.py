"""Poses in a whole map by constellation, in a time that does not grow with the map.

Every triangle of neighbouring landmarks is stored once, in the map's own frame, in one table sorted
by its sides. A query lays its triangles on equal ones, those with the fewest equals first and only
as many as a fixed budget of comparisons allows: in a larger map each triangle has more equals, so
fewer are tried, but a wrong vote finds ever more room to be alone in, and a true one never is.
"""

import numpy as np
from jaxtyping import Float64, Int32

from sl3d_slam.loops.landmark_triangles import ID_BITS, unique_triads
from sl3d_slam.loops.landmark_votes import (
    SIDE_TOLERANCE_M,
    TriangleTable,
    count_equals,
    gather_cells,
    lay_on_equals,
    make_table,
)
from sl3d_slam.loops.triangles import all_triangles

NEIGHBOURS = 9
MAX_LINES = 40
# a 30th of all possible ones still put the true pose first, for 16 of 16 scans in 10,000 lines
MAX_COMPARISONS = 800_000
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
        rarest = np.argsort(counts, kind="stable")
        affordable = np.searchsorted(np.cumsum(counts[rarest]), MAX_COMPARISONS, side="right")
        chosen = triangles[rarest[:affordable]]
        votes = lay_on_equals(xy, chosen, self._xy, self._table, MAX_VOTES)
        cells = gather_cells(votes, min(NUM_CELLS, 4 * limit))
        return cells[np.argsort(-cells[:, 3], kind="stable")[:limit]]

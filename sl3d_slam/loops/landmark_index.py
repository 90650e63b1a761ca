"""Poses in a whole map by constellation, in a time that does not grow with the map.

Every triangle of neighbouring landmarks is stored once, in the map's own frame, in one table sorted
by its sides. A query lays its triangles on equal ones, those with the fewest equals first and only
as many as a fixed budget of comparisons allows: in a larger map each triangle has more equals, so
fewer are tried, but a wrong vote finds ever more room to be alone in, and a true one never is.
"""

from collections.abc import Iterable, Sequence

import numpy as np
from jaxtyping import Float64, Int32, Int64

from sl3d_slam.loops.landmark_votes import (
    NUM_BUCKETS,
    SIDE_TOLERANCE_M,
    buckets_of,
    count_equals,
    gather_cells,
    lay_on_equals,
)
from sl3d_slam.loops.triangles import all_triangles, local_triangles

NEIGHBOURS = 9
MAX_LINES = 40
ID_BITS = 21
CHUNK = 2048
# a 30th of all possible ones still put the true pose first, for 16 of 16 scans in 10,000 lines
MAX_COMPARISONS = 800_000
MAX_VOTES = 400_000
NUM_CELLS = 160

Triads = Int32[np.ndarray, "T 3"]  # landmark numbers: opposite the longest side first


class LandmarkIndex:
    """The triangles of a map's standing lines, by their sides."""

    def __init__(
        self, xy: Float64[np.ndarray, "L 2"], neighbourhoods: Iterable[Int64[np.ndarray, "M"]]
    ) -> None:
        """Index lines seen from above, metres in one level frame of the map.

        ``neighbourhoods`` are lines that one sensor sees together, strongest first; each gives the
        triangles of its first 40 with their near neighbours.
        """
        if len(xy) >= 1 << ID_BITS:
            raise ValueError(f"a map of more than {(1 << ID_BITS) - 1} standing lines")
        self._xy = np.ascontiguousarray(xy, np.float64)
        triads = _unique_triads(self._xy, neighbourhoods)
        bucket = buckets_of(self._xy, triads)
        order = np.argsort(bucket, kind="stable")
        self._triads: Triads = triads[order]
        self._starts = np.searchsorted(bucket[order], np.arange(NUM_BUCKETS + 1)).astype(np.int64)

    def __len__(self) -> int:
        """Return the number of stored triangles."""
        return len(self._triads)

    @property
    def num_bytes(self) -> int:
        """Return the memory that the tables take."""
        return int(self._triads.nbytes + self._starts.nbytes + self._xy.nbytes)

    def query(
        self, xy: Float64[np.ndarray, "V 2"], weights: Float64[np.ndarray, "V"], limit: int
    ) -> Float64[np.ndarray, "K 4"]:
        """Return the best-voted planar poses of a scan, rows of yaw_rad, x_m, y_m and votes.

        ``xy`` are the scan's standing lines in its level frame; the poses are in the level frame
        of the map, best first, at most ``limit``. Neighbouring cells may give the same pose twice.
        """
        xy = np.ascontiguousarray(xy[np.argsort(-weights, kind="stable")[:MAX_LINES]])
        triangles = all_triangles(xy, SIDE_TOLERANCE_M)
        counts = count_equals(xy, triangles, self._starts)
        rarest = np.argsort(counts, kind="stable")
        affordable = np.searchsorted(np.cumsum(counts[rarest]), MAX_COMPARISONS, side="right")
        chosen = triangles[rarest[:affordable]]
        votes = lay_on_equals(xy, chosen, self._xy, self._triads, self._starts, MAX_VOTES)
        cells = gather_cells(votes, min(NUM_CELLS, 4 * limit))
        return cells[np.argsort(-cells[:, 3], kind="stable")[:limit]]


def _unique_triads(
    xy: Float64[np.ndarray, "L 2"], neighbourhoods: Iterable[Int64[np.ndarray, "M"]]
) -> Triads:
    """Return the triangles of all neighbourhoods, each once, sorted by their lines."""
    keys, batch = [np.zeros(0, np.int64)], []
    for members in neighbourhoods:
        members = members[:MAX_LINES]
        batch.append(members[local_triangles(xy[members], NEIGHBOURS)])
        if len(batch) == CHUNK:
            keys.append(_unique_keys(batch))
            batch = []
    keys.append(_unique_keys(batch))
    key = np.unique(np.concatenate(keys))
    mask = (1 << ID_BITS) - 1
    rows = [key >> (2 * ID_BITS), (key >> ID_BITS) & mask, key & mask]
    return np.stack(rows, axis=1).astype(np.int32)


def _unique_keys(batch: Sequence[np.ndarray]) -> Int64[np.ndarray, "T"]:
    rows = np.concatenate([np.zeros((0, 3), np.int64), *batch])
    return np.unique((rows[:, 0] << (2 * ID_BITS)) | (rows[:, 1] << ID_BITS) | rows[:, 2])

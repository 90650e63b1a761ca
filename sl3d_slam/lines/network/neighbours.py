"""Which neighbours of a point the network looks at."""

import numpy as np
from jaxtyping import Int64

from sl3d_slam.lines.network.nearest import nearest_of_ranks

CELL_M = 1.0
MIN_COLUMNS = 16
MAX_COLUMNS = 1024


def skip_neighbours(
    points: np.ndarray, k: int, stride: int, cell_m: float = CELL_M
) -> Int64[np.ndarray, "M k"]:
    """Return of the ``stride * k`` nearest points of each point every ``stride``-th, nearest first.

    ``points`` are x, y, z and anything behind. The first neighbour is the point itself. Where the
    cloud has fewer than ``stride * k`` points, all of them are spread over the k places, some more
    than once. ``cell_m`` is the side of the columns that are searched: about as far as the
    neighbours reach.
    """
    if len(points) == 0:
        return np.zeros((0, k), np.int64)
    reach = min(stride * k, len(points))
    cells = points[:, :3].astype(np.float64)
    cells -= cells.min(axis=0)
    extent_m = float(cells[:, :2].max())
    cells /= max(min(cell_m, extent_m / MIN_COLUMNS), extent_m / MAX_COLUMNS, 1e-9)
    shape = cells.max(axis=0).astype(np.int64) + 1
    column = cells[:, 0].astype(np.int64) * shape[1] + cells[:, 1].astype(np.int64)
    order = np.argsort(column, kind="stable")
    start = np.zeros(shape[0] * shape[1] + 1, np.int64)
    np.cumsum(np.bincount(column, minlength=len(start) - 1), out=start[1:])
    columns = np.ascontiguousarray(cells[order].T)
    return nearest_of_ranks(columns, order, start, shape, np.arange(k) * reach // k)

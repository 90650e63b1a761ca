"""Which neighbours of a point the network looks at."""

import numpy as np
import small_gicp
from jaxtyping import Int64


def skip_neighbours(points: np.ndarray, k: int, stride: int) -> Int64[np.ndarray, "M k"]:
    """Return of the ``stride * k`` nearest points of each point every ``stride``-th, nearest first.

    ``points`` are x, y, z and anything behind. The first neighbour is the point itself. Where the
    cloud has fewer than ``stride * k`` points, all of them are spread over the k places, some more
    than once.
    """
    if len(points) == 0:
        return np.zeros((0, k), np.int64)
    reach = min(stride * k, len(points))
    ranks = np.arange(k) * reach // k
    cloud = np.ascontiguousarray(points[:, :3], dtype=np.float64)
    found, _ = small_gicp.KdTree(cloud).batch_knn_search(cloud, reach, num_threads=2)
    return np.asarray(found)[:, ranks].astype(np.int64)

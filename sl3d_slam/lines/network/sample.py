"""The points of a scan that the network sees."""

import numpy as np
from jaxtyping import Float32

from sl3d_slam.lines.grid import voxel_means
from sl3d_slam.lines.network.settings import NetworkSettings

MIN_RANGE_M = 1.5
MAX_RANGE_M = 120.0


def network_points(
    points_lidar: np.ndarray, settings: NetworkSettings, max_points: int | None = None
) -> Float32[np.ndarray, "M 3"]:
    """Return the voxel means of a scan (N, 3), the ``max_points`` nearest the sensor, in metres.

    In the frame of the scan, ordered by voxel; the same whatever the order of the scan's points,
    but for the rounding of sums. Returns within 1.5 m (the vehicle) are left out.
    """
    points = np.ascontiguousarray(points_lidar, dtype=np.float64)
    means = voxel_means(points, settings.voxel_size_m, MIN_RANGE_M, MAX_RANGE_M)[0]
    limit = settings.max_points if max_points is None else max_points
    if len(means) > limit:
        squared = np.einsum("ij,ij->i", means, means)
        means = means[np.sort(np.argpartition(squared, limit - 1)[:limit])]
    return means.astype(np.float32)

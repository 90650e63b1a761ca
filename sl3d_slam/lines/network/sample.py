"""The points of a scan that the network sees."""

import numpy as np
from jaxtyping import Float32, Float64

from sl3d_slam.geometry.ground import heights_above_ground, up_direction
from sl3d_slam.lines.grid import voxel_means
from sl3d_slam.lines.network.settings import NetworkSettings

MIN_RANGE_M = 1.5
MAX_RANGE_M = 120.0
CLEARANCE_M = 0.2


def network_points(
    points_lidar: np.ndarray,
    settings: NetworkSettings,
    max_points: int | None = None,
    up: Float64[np.ndarray, "3"] | None = None,
) -> Float32[np.ndarray, "M 4"]:
    """Return x, y, z of voxel means of a scan (N, 3) and their height above the ground, in metres.

    The ``max_points`` nearest the sensor in the frame of the scan, ordered by voxel; the same
    whatever the order of the scan's points, but for the rounding of sums. Returns within 1.5 m (the
    vehicle) are left out, and the ground where the settings say so. ``up`` is the direction against
    gravity in the lidar frame, where it is known already.
    """
    points = np.ascontiguousarray(points_lidar, dtype=np.float64)
    means = voxel_means(points, settings.voxel_size_m, MIN_RANGE_M, MAX_RANGE_M)[0]
    if len(means) == 0:
        return np.zeros((0, 4), np.float32)
    heights = heights_above_ground(means, up_direction(means) if up is None else up)
    sample = np.column_stack([means, heights]).astype(np.float32)
    if settings.drop_ground:
        sample = sample[heights > CLEARANCE_M]
    limit = settings.max_points if max_points is None else max_points
    if len(sample) > limit:
        squared = np.einsum("ij,ij->i", sample[:, :3], sample[:, :3])
        sample = sample[np.sort(np.argpartition(squared, limit - 1)[:limit])]
    return sample

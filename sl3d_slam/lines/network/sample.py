"""The points of a scan that the network sees."""

import numpy as np
from jaxtyping import Float32

from sl3d_slam.lines.grid import voxel_means
from sl3d_slam.lines.network.settings import NetworkSettings
from sl3d_slam.lines.scene import Scene


def network_points(
    scene: Scene, settings: NetworkSettings, max_points: int | None = None
) -> Float32[np.ndarray, "M 4"]:
    """Return x, y, z (level frame) of voxel means of a scene and their height above the ground.

    The ``max_points`` nearest the sensor, ordered by voxel; the same whatever the order of the
    scan's points, but for the rounding of sums. Each of the scene's smaller voxels counts once, so
    that a near pole with many returns weighs no more than it is wide.
    """
    smaller = np.column_stack([scene.points, scene.heights])
    sample = voxel_means(smaller, settings.voxel_size_m, 0.0, np.inf)[0].astype(np.float32)
    limit = settings.max_points if max_points is None else max_points
    if len(sample) > limit:
        squared = np.einsum("ij,ij->i", sample[:, :3], sample[:, :3])
        sample = sample[np.sort(np.argpartition(squared, limit - 1)[:limit])]
    return sample

"""One point a voxel, chosen by chance: the thinning of training scans and of their votes."""

import numpy as np
from jaxtyping import Int64

from sl3d_slam.geometry.se3 import Points


def voxel_keys(points: Points, voxel_m: float) -> Int64[np.ndarray, "N"]:
    """Return one number a voxel for each point; points must lie within 250 km of the origin."""
    cells = np.floor(points / voxel_m).astype(np.int64) + 1_000_000
    return (cells[:, 0] << 42) | (cells[:, 1] << 21) | cells[:, 2]


def voxel_choice(
    points: Points, voxel_m: float, rng: np.random.Generator
) -> Int64[np.ndarray, "V"]:
    """Return one point of every occupied voxel, drawn at random; in random order."""
    order = rng.permutation(len(points))
    first = np.unique(voxel_keys(points[order], voxel_m), return_index=True)[1]
    return order[np.sort(first)]

"""Geometric adaptation: what a network says of a scan in every pose it may come in, put to a vote.

The network sees offsets between points alone, so a turn or a shift by itself tells it nothing new.
What they change is the sampling: another voxel grid, another point of each voxel, other points
left out. What survives all of that is structure.
"""

import numpy as np
from jaxtyping import Bool, Float32, Int64
from pydantic import Field

from sl3d_slam.config import Settings
from sl3d_slam.geometry.se3 import Points, from_yaw, transform_points
from sl3d_slam.learning.segmentation import PointNetwork, line_shares
from sl3d_slam.learning.thinning import voxel_keys


class AdaptationSettings(Settings):
    """The random views of a scan.

    ``shift_m`` is the side of the square that the sensor is moved in, ``turn_deg`` the range of
    its heading; up to ``max_left_out`` of the voxels are left out of a view; those beyond
    ``max_points``, nearest first, always are.
    """

    views: int = Field(default=10, ge=1)
    shift_m: float = Field(default=20.0, ge=0)
    turn_deg: float = Field(default=360.0, ge=0)
    voxel_size_m: float = Field(default=0.25, gt=0)
    max_points: int = Field(default=20_000, ge=50)
    max_left_out: float = Field(default=0.3, ge=0, lt=1)


def line_votes(
    network: PointNetwork,
    points_lidar: Points,
    settings: AdaptationSettings,
    rng: np.random.Generator,
    neighbours: tuple[int, int] = (20, 4),
) -> Float32[np.ndarray, "N"]:
    """Return for every point the mean vote of the views that showed it; 0 where none did.

    A view votes with the probability that a point lies on a line. ``neighbours`` are how many the
    network looks at, and their stride.
    """
    votes = np.zeros(len(points_lidar), np.float32)
    seen = np.zeros(len(points_lidar), np.float32)
    for _ in range(settings.views):
        chosen, voxel_of = random_view(points_lidar, settings, rng)
        view = moved_at_random(points_lidar[chosen], settings, rng)
        (shares,) = line_shares(network, [view], *neighbours)
        shown = voxel_of >= 0
        votes[shown] += shares[voxel_of[shown]]
        seen += shown
    return votes / np.maximum(seen, 1.0)


def random_view(
    points_lidar: Points, settings: AdaptationSettings, rng: np.random.Generator
) -> tuple[Int64[np.ndarray, "V"], Int64[np.ndarray, "N"]]:
    """Return the points that stand for the voxels of a view, and the voxel of every point.

    The voxel grid lies as in a scan turned and shifted at random; a voxel is shown by one of its
    points. Points whose voxel is not shown get -1.
    """
    moved = moved_at_random(points_lidar, settings, rng)
    order = rng.permutation(len(moved))
    keys = voxel_keys(moved[order], settings.voxel_size_m)
    _, first, inverse = np.unique(keys, return_index=True, return_inverse=True)
    chosen = order[first]
    voxel_of = np.empty(len(moved), np.int64)
    voxel_of[order] = inverse
    shown = _shown(points_lidar[chosen], settings, rng)
    renumber = np.where(shown, np.cumsum(shown) - 1, -1)
    return chosen[shown], renumber[voxel_of]


def _shown(
    points_lidar: Points, settings: AdaptationSettings, rng: np.random.Generator
) -> Bool[np.ndarray, "V"]:
    """Leave out a random share, then all but the nearest."""
    shown = rng.random(len(points_lidar)) >= rng.uniform(0.0, settings.max_left_out)
    if shown.sum() > settings.max_points:
        squared = np.einsum("nd,nd->n", points_lidar, points_lidar)
        limit = np.partition(squared[shown], settings.max_points)[settings.max_points]
        shown &= squared < limit
    return shown


def moved_at_random(
    points: Points, settings: AdaptationSettings, rng: np.random.Generator
) -> Points:
    """Turn a scan about z and shift it in the plane."""
    half_m, half_turn = 0.5 * settings.shift_m, 0.5 * np.radians(settings.turn_deg)
    shift = np.append(rng.uniform(-half_m, half_m, 2), 0.0)
    return transform_points(from_yaw(float(rng.uniform(-half_turn, half_turn)), shift), points)

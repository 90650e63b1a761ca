"""What both line finders start from: one scan, levelled, thinned, without its ground."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from sl3d_slam.config import LineSettings
from sl3d_slam.geometry.gravity import gravity_up
from sl3d_slam.geometry.ground import UP, heights_above_ground, up_direction
from sl3d_slam.geometry.se3 import Points, rotation_between
from sl3d_slam.lines.grid import cell_index, gathered, rows_in_square, voxel_means
from sl3d_slam.lines.structure import CELL_M, local_structure
from sl3d_slam.lines.view import nearest_ranges

MIN_RANGE_M = 1.5
CLEARANCE_M = 0.25


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """A scan in the level frame: the sensor's origin, z against gravity.

    Attributes
    ----------
    up : (3,) the way up in the lidar frame.
    ground_up : (3,) the normal of the ground around the sensor in the lidar frame.
    R_level_lidar : rotation to the level frame.
    points : (N, 3) voxel means above the ground.
    heights : (N,) metres above the local ground.
    counts : (N,) returns per voxel.
    members : (P, 3) all returns in range, grouped by voxel, still in the lidar frame.
    member_start, member_stop : (N,) the group of each voxel in ``members``.
    structure : (N, 6) see :func:`local_structure`.
    index : horizontal cell index of ``points``.
    ranges : nearest range per direction, see :func:`nearest_ranges`.
    half_width_m : half the side of the indexed square.
    """

    up: Float64[np.ndarray, "3"]
    ground_up: Float64[np.ndarray, "3"]
    R_level_lidar: Float64[np.ndarray, "3 3"]
    points: Points
    heights: Float64[np.ndarray, "N"]
    counts: Int64[np.ndarray, "N"]
    members: Float64[np.ndarray, "P 3"]
    member_start: Int64[np.ndarray, "N"]
    member_stop: Int64[np.ndarray, "N"]
    structure: Float64[np.ndarray, "N 6"]
    index: tuple[Int64[np.ndarray, "N"], Int64[np.ndarray, "C"]]
    ranges: Float64[np.ndarray, "A E"]
    half_width_m: float

    def around(self, place: Float64[np.ndarray, "2"], radius_m: float) -> Int64[np.ndarray, "M"]:
        """Return the voxels in the square of half side ``radius_m`` (or a cell more) at a place."""
        return rows_in_square(self.index[1], self.half_width_m, CELL_M, place, radius_m)

    def returns_of(self, voxels: Int64[np.ndarray, "V"]) -> Points:
        """Return all returns of the given voxels."""
        first, stop = self.member_start[voxels], self.member_stop[voxels]
        return gathered(self.members, first, stop, self.R_level_lidar)


def vertical_gap_m(ranges_m: np.ndarray) -> np.ndarray:
    """Return the largest step between neighbouring returns on an upright thing at a range."""
    return 0.5 + 0.02 * ranges_m


def make_scene(points_lidar: Points, settings: LineSettings) -> Scene:
    """Thin, level and clear a scan, and describe the surroundings of each voxel."""
    means, counts, members, start = voxel_means(
        points_lidar, settings.voxel_size_m, MIN_RANGE_M, settings.max_range_m
    )
    ground_up = up_direction(means)
    heights = heights_above_ground(means, ground_up)
    up = gravity_up(means, heights, ground_up)
    R_level_lidar = rotation_between(up, UP)
    kept = np.flatnonzero(heights > CLEARANCE_M)
    level = means[kept] @ R_level_lidar.T
    order, cell_start = cell_index(level, CELL_M, settings.max_range_m)
    kept, level = kept[order], np.ascontiguousarray(level[order])
    index = (np.arange(len(kept)), cell_start)
    columns = np.ascontiguousarray(level.T)
    slab = 0.5 + 0.015 * np.linalg.norm(level, axis=1)
    return Scene(
        up=up,
        ground_up=ground_up,
        R_level_lidar=R_level_lidar,
        points=level,
        heights=heights[kept],
        counts=counts[kept],
        members=members,
        member_start=start[kept],
        member_stop=start[kept + 1],
        structure=local_structure(columns, cell_start, settings.max_range_m, slab),
        index=index,
        ranges=nearest_ranges(members, R_level_lidar),
        half_width_m=settings.max_range_m,
    )

"""The surfaces of the last scans in voxels, and the pose at which a scan's lie on them.

small_gicp's voxelised GICP has no robust kernel in Python, and without one moving cars pull: where
an eighth of the points drive along, a step erred by 56 mm along the road, with it by 5, and by half
as much everywhere.
"""

from dataclasses import dataclass

import numpy as np

from sl3d_slam.geometry.gaussian_voxels import GaussianVoxels, Surfaces
from sl3d_slam.geometry.se3 import Transform, distance_m, invert, rotation_angle_rad
from sl3d_slam.geometry.surface_fit import SurfaceFit, lay_on

MEMORY_SCANS = 150
SETTLED_M = 0.2  # surfaces that move a pose by more were led to the wrong place
SETTLED_RAD = np.radians(1.0)


@dataclass(frozen=True, slots=True)
class Alignment:
    """Where a scan's surfaces lie on the map's, and whether that is near to where it was led."""

    fit: SurfaceFit
    settled: bool


class SurfaceMap:
    """Surfaces of the last 150 scans, one mean and covariance a voxel of a metre."""

    def __init__(self) -> None:
        self._voxels = GaussianVoxels(MEMORY_SCANS)

    @property
    def num_voxels(self) -> int:
        """How many voxels there are."""
        return len(self._voxels)

    def insert(self, surfaces: Surfaces, T_map_lidar: Transform) -> None:
        """Add a scan's surfaces."""
        self._voxels.insert(surfaces, T_map_lidar)

    def align(self, surfaces: Surfaces, T_map_led: Transform) -> Alignment:
        """Lay surfaces on the map's from a pose near it; the map may not be empty."""
        fit = lay_on(self._voxels.rows, surfaces, T_map_led)
        moved = invert(T_map_led) @ fit.T_target_source
        near = distance_m(moved) < SETTLED_M and rotation_angle_rad(moved) < SETTLED_RAD
        return Alignment(fit, bool(fit.rests and near and fit.support > 0.0))

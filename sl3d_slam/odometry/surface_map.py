"""The surfaces of the last scans in voxels, and the pose at which a scan's lie on them.

Voxelised GICP (Koide et al., ICRA 2021) with a robust kernel. small_gicp keeps the voxels; its
Python interface has no kernel, and without one moving cars pull: where an eighth of the points
drive along, a step erred by 56 mm along the road, with it by 5, and by half as much everywhere.
"""

from dataclasses import dataclass

import numpy as np
import small_gicp
from jaxtyping import Float64

from sl3d_slam.geometry.se3 import Transform, distance_m, exp, invert, rotation_angle_rad
from sl3d_slam.odometry.noise import LOOSE, Matrix6
from sl3d_slam.odometry.robust_gicp import Voxels, normal_equations, voxels_of

VOXEL_M = 1.0
MEMORY_SCANS = 150
FIRST_WIDTH, LAST_WIDTH = 16.0, 0.5  # of the kernel; a plane of two centimetres' noise costs 0.2
NARROWING = 0.25
MAX_STEPS = 20
LEAST_STEP_M = 1e-3
LEAST_STEP_RAD = np.radians(0.02)
SETTLED_M = 0.2  # surfaces that move a pose by more were led to the wrong place
SETTLED_RAD = np.radians(1.0)


@dataclass(frozen=True, slots=True)
class Alignment:
    """Where a scan's surfaces lie on the map's.

    ``hessian`` is of the weighted cost, rotation first, at the lidar's frame; ``misfit`` is the
    weighted mean of the cost of a point; ``settled`` tells that the pose came to rest near to where
    it was led.
    """

    T_map_lidar: Transform
    hessian: Matrix6
    misfit: float
    settled: bool


class SurfaceMap:
    """Surfaces of the last 150 scans, one mean and covariance a voxel of a metre."""

    def __init__(self) -> None:
        self._map = small_gicp.GaussianVoxelMap(VOXEL_M)
        self._map.set_lru(horizon=MEMORY_SCANS, clear_cycle=10)

    @property
    def num_voxels(self) -> int:
        """How many voxels there are."""
        return int(self._map.size())

    def insert(self, surfaces: small_gicp.PointCloud, T_map_lidar: Transform) -> None:
        """Add a scan's surfaces."""
        self._map.insert(surfaces, T_map_lidar)

    def align(self, surfaces: small_gicp.PointCloud, T_map_led: Transform) -> Alignment:
        """Lay surfaces on the map's from a pose near it; the map may not be empty.

        The kernel of Geman and McClure narrows step by step (graduated non-convexity, Zhou et al.,
        ECCV 2016), so that surfaces far off can still pull a pose that was led some decimetres
        away, and in the end count for nothing. Gauss-Newton.
        """
        points = np.ascontiguousarray(surfaces.points()[:, :3])
        normals = np.ascontiguousarray(surfaces.normals()[:, :3])
        voxels = self._voxels()
        T_map_lidar, width, resting = T_map_led, FIRST_WIDTH, False
        for _ in range(MAX_STEPS):
            pose = np.ascontiguousarray(T_map_lidar)
            hessian, gradient, cost, weight = normal_equations(
                points, normals, voxels, pose, VOXEL_M, width
            )
            step = -np.linalg.solve(hessian + LOOSE, gradient)
            T_map_lidar = T_map_lidar @ exp(step)
            resting = _is_small(step)
            if resting and width == LAST_WIDTH:
                break
            width = max(LAST_WIDTH, NARROWING * width)
        moved = invert(T_map_led) @ T_map_lidar
        near = distance_m(moved) < SETTLED_M and rotation_angle_rad(moved) < SETTLED_RAD
        settled = bool(resting and near and weight > 0.0)
        return Alignment(T_map_lidar, hessian, cost / max(weight, 1.0), settled)

    def _voxels(self) -> Voxels:
        means = np.ascontiguousarray(self._map.voxel_points())
        covariances = np.ascontiguousarray(self._map.voxel_covs()).reshape(-1, 16)
        return voxels_of(means, covariances, VOXEL_M)


def _is_small(step: Float64[np.ndarray, "6"]) -> bool:
    turned_rad, moved_m = np.linalg.norm(step[:3]), np.linalg.norm(step[3:])
    return bool(turned_rad < LEAST_STEP_RAD and moved_m < LEAST_STEP_M)

"""Which way is up, and how high is each point above the street.

The ground is a low, gently sloping surface: the lowest returns of coarse cells, lowered to a cone
of limited slope (so that a cell which sees only a wall takes its height from the street beside it)
and filled in between.
"""

import numpy as np
from jaxtyping import Bool, Float64

from sl3d_slam.geometry.ground_grid import (
    LOW_BAND_M,
    above_grid,
    filled,
    low_grid,
    lowest_rows,
    slope_envelope,
    without_ghosts,
)
from sl3d_slam.geometry.se3 import Points, rotation_between

FIT_RANGE_M = 30.0
FIT_CELL_M = 1.5
MAX_TILT_DEG = 25.0
CELL_M = 1.0
GRID_HALF_WIDTH_M = 64.0
MIN_CELLS = 8
MARGIN = 1.5

UP = np.array([0.0, 0.0, 1.0])


def up_direction(points_lidar: Points) -> Float64[np.ndarray, "3"]:
    """Return the unit normal of the ground around the sensor, pointing up, in the lidar frame.

    A plane is fitted to the lowest returns of 1.5 m cells within 30 m, with weights that narrow
    from metres to decimetres, so that walls and cars in those cells lose their say. Valid for
    sensors tilted by up to 25 degrees. Where too little ground is seen, the frame's own z axis is
    returned.
    """
    near = _lowest_per_cell(
        points_lidar[_in_horizontal_range(points_lidar, 2.0, FIT_RANGE_M)], FIT_CELL_M / 3
    )
    up = UP
    for scale_m in (0.4, 0.15):
        level = near @ rotation_between(up, UP).T
        lowest = _lowest_per_cell(level, FIT_CELL_M)
        if len(lowest) < MIN_CELLS:
            return UP.copy()
        normal = _robust_plane_normal(lowest, scale_m)
        up = rotation_between(up, UP).T @ normal
        up /= np.linalg.norm(up)
    if up[2] < np.cos(np.radians(MAX_TILT_DEG)):
        return UP.copy()
    return up


def heights_above_ground(
    points_lidar: Points, up: Float64[np.ndarray, "3"]
) -> Float64[np.ndarray, "N"]:
    """Return the height of each point above the local ground, metres along ``up``.

    Follows slopes of up to 25 % against ``up``; farther than 64 m from the sensor the height of
    the nearest known ground is used. All zero where no point is given.
    """
    level = points_lidar @ rotation_between(up, UP).T
    if len(level) == 0:
        return np.zeros(0)
    return above_grid(level, _ground_grid(level), GRID_HALF_WIDTH_M, CELL_M)


def ground_mask(
    points_lidar: Points, up: Float64[np.ndarray, "3"], clearance_m: float = 0.25
) -> Bool[np.ndarray, "N"]:
    """Tell which points lie less than ``clearance_m`` above the local ground (or below it)."""
    return heights_above_ground(points_lidar, up) < clearance_m


def _in_horizontal_range(points: Points, near_m: float, far_m: float) -> Bool[np.ndarray, "N"]:
    squared = points[:, 0] ** 2 + points[:, 1] ** 2
    return (squared > near_m**2) & (squared < far_m**2)


def _lowest_per_cell(
    points: Float64[np.ndarray, "N 3"], cell_m: float
) -> Float64[np.ndarray, "C 3"]:
    """Return the lowest point of each occupied cell within the fitting range."""
    return points[lowest_rows(points, MARGIN * FIT_RANGE_M, cell_m)]


def _robust_plane_normal(points: Points, final_scale_m: float) -> Float64[np.ndarray, "3"]:
    """Fit ``z = a x + b y + c`` with weights that narrow; near cells count more."""
    weights_near = 1.0 / (5.0 + np.hypot(points[:, 0], points[:, 1]))
    design = np.c_[points[:, :2], np.ones(len(points))]
    solution = np.array([0.0, 0.0, np.median(points[:, 2])])
    for scale_m in np.geomspace(3.0, final_scale_m, 10):
        residual = points[:, 2] - design @ solution
        weights = weights_near / (1.0 + (residual / scale_m) ** 2) ** 2
        normal_matrix = design.T @ (design * weights[:, None]) + 1e-9 * np.eye(3)
        solution = np.linalg.solve(normal_matrix, design.T @ (weights * points[:, 2]))
    normal = np.array([-solution[0], -solution[1], 1.0])
    return normal / np.linalg.norm(normal)


def _ground_grid(level: Points) -> Float64[np.ndarray, "X Y"]:
    """Return the height of the ground on a square grid of 1 m cells centred on the sensor."""
    lowest = without_ghosts(low_grid(level, GRID_HALF_WIDTH_M, CELL_M), CELL_M)
    envelope = slope_envelope(lowest, CELL_M)
    known = np.isfinite(lowest) & (lowest <= envelope + LOW_BAND_M)
    return filled(np.where(known, lowest, 0.0), known)

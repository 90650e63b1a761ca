"""Which way is up, and how high is each point above the street.

The ground is a low, gently sloping surface: the lowest returns of coarse cells, lowered to a cone
of limited slope (so that a cell which sees only a wall takes its height from the street beside it)
and filled in between.
"""

import numpy as np
from jaxtyping import Float64

from sl3d_slam.geometry.ground_grid import (
    LOW_BAND_M,
    above_grid,
    filled,
    low_grid,
    lowest_rows,
    plane_normal,
    slope_envelope,
    without_ghosts,
)
from sl3d_slam.geometry.se3 import Points, rotation_between

FIT_RING_M = (2.0, 30.0)
LEVEL_RING_M = (0.0, 45.0)  # those of the fit, after a turn
FIT_CELL_M = 1.5
MAX_TILT_DEG = 25.0
CELL_M = 1.0
GRID_HALF_WIDTH_M = 64.0
MIN_CELLS = 8

UP = np.array([0.0, 0.0, 1.0])


def up_direction(points_lidar: Points) -> Float64[np.ndarray, "3"]:
    """Return the unit normal of the ground around the sensor, pointing up, in the lidar frame.

    A plane is fitted to the lowest returns of 1.5 m cells within 30 m, with weights that narrow
    from metres to decimetres, so that walls and cars in those cells lose their say. Valid for
    sensors tilted by up to 25 degrees. Where too little ground is seen, the frame's own z axis is
    returned.
    """
    near = _lowest_per_cell(points_lidar, FIT_RING_M, FIT_CELL_M / 3)
    up = UP
    for scale_m in (0.4, 0.15):
        level = near @ rotation_between(up, UP).T
        lowest = _lowest_per_cell(level, LEVEL_RING_M, FIT_CELL_M)
        if len(lowest) < MIN_CELLS:
            return UP.copy()
        normal = plane_normal(lowest, scale_m)
        up = rotation_between(up, UP).T @ normal
        up /= np.linalg.norm(up)
    if not up[2] >= np.cos(np.radians(MAX_TILT_DEG)):  # NaN where all ground lies on one line
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


def _lowest_per_cell(
    points: Float64[np.ndarray, "N 3"], ring_m: tuple[float, float], cell_m: float
) -> Float64[np.ndarray, "C 3"]:
    """Return the lowest point of each cell that those within horizontal ranges occupy."""
    return points[lowest_rows(points, ring_m, LEVEL_RING_M[1], cell_m)]


def _ground_grid(level: Points) -> Float64[np.ndarray, "X Y"]:
    """Return the height of the ground on a square grid of 1 m cells centred on the sensor."""
    lowest = without_ghosts(low_grid(level, GRID_HALF_WIDTH_M, CELL_M), CELL_M)
    envelope = slope_envelope(lowest, CELL_M)
    known = np.isfinite(lowest) & (lowest <= envelope + LOW_BAND_M)
    return filled(np.where(known, lowest, 0.0), known)

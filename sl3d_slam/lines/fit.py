"""Robust fit of one upright line, compiled."""

from typing import no_type_check

import numpy as np
from numba import njit

TILT_PRIOR_RAD = 0.05
POINT_SIGMA_M = 0.1


@njit(cache=True)
@no_type_check
def fit_upright(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fit ``xy = base + slope (z - base_z)`` robustly, leaning towards the vertical.

    Returns the base point (3,) at the weighted mean of the points (N, 3), and the slope (2,). The
    lean is a prior of 0.05 rad, felt where few points or little height leave the slope open.
    """
    weights = np.ones(len(points))
    stiffness = (POINT_SIGMA_M / TILT_PRIOR_RAD) ** 2
    base, slope = np.zeros(3), np.zeros(2)
    for scale_m in (0.3, 0.15, 0.1, 0.1):
        base = _weighted_mean(points, weights)
        moment_x = moment_y = 0.0
        spread = stiffness
        for i in range(len(points)):
            rise = points[i, 2] - base[2]
            moment_x += weights[i] * rise * (points[i, 0] - base[0])
            moment_y += weights[i] * rise * (points[i, 1] - base[1])
            spread += weights[i] * rise * rise
        slope = np.array([moment_x / spread, moment_y / spread])
        for i in range(len(points)):
            rise = points[i, 2] - base[2]
            dx = points[i, 0] - base[0] - slope[0] * rise
            dy = points[i, 1] - base[1] - slope[1] * rise
            weights[i] = 1.0 / (1.0 + (dx * dx + dy * dy) / (scale_m * scale_m)) ** 2
    return base, slope


@njit(cache=True)
@no_type_check
def _weighted_mean(points: np.ndarray, weights: np.ndarray) -> np.ndarray:
    total = np.zeros(3)
    mass = 0.0
    for i in range(len(points)):
        mass += weights[i]
        for axis in range(3):
            total[axis] += weights[i] * points[i, axis]
    return total / mass

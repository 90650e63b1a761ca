"""Robust fit of one upright line, and of the axis of the pole behind it; compiled."""

from typing import no_type_check

import numpy as np
from numba import njit

TILT_PRIOR_RAD = 0.05
POINT_SIGMA_M = 0.1
RANGE_NOISE_M = 0.02
GATE = 2.6


@njit(cache=True, nogil=True)
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


@njit(cache=True, nogil=True)
@no_type_check
def _weighted_mean(points: np.ndarray, weights: np.ndarray) -> np.ndarray:
    total = np.zeros(3)
    mass = 0.0
    for i in range(len(points)):
        mass += weights[i]
        for axis in range(3):
            total[axis] += weights[i] * points[i, axis]
    return total / mass


@njit(cache=True, nogil=True)
@no_type_check
def axis_behind(
    front: np.ndarray, slope: np.ndarray, returns: np.ndarray
) -> tuple[np.ndarray, float]:
    """Move a line from the visible front of a cylinder to its axis; return it and the radius.

    Beams are evenly spread over the width, whose standard deviation is then radius / sqrt(3), and
    the returns lie pi / 4 radii in front of the axis on average. Branches and signs are left out
    by a gate on the median distance, which is half a radius where there are none.
    """
    range_m = np.sqrt(front[0] ** 2 + front[1] ** 2)
    sight_x, sight_y = front[0] / range_m, front[1] / range_m
    rise = returns[:, 2] - front[2]
    x = returns[:, 0] - front[0] - slope[0] * rise
    y = returns[:, 1] - front[1] - slope[1] * rise
    across, depth = sight_x * y - sight_y * x, sight_x * x + sight_y * y
    middle = np.median(across)
    inside = np.ones(len(across), np.bool_)
    for _ in range(3):
        distance = np.abs(across - middle)
        inside = distance <= GATE * np.median(distance) + RANGE_NOISE_M
        middle = across[inside].mean()
    radius = np.sqrt(max(3.0 * (across[inside].var() - RANGE_NOISE_M**2), 0.0))
    deep = depth[inside]
    distance = np.abs(deep - np.median(deep))
    gate_m = max(GATE * np.median(distance), radius) + RANGE_NOISE_M
    behind = deep[distance <= gate_m].mean() + 0.25 * np.pi * radius
    shift_x = sight_x * behind - sight_y * middle
    shift_y = sight_y * behind + sight_x * middle
    return front + np.array([shift_x, shift_y, 0.0]), radius

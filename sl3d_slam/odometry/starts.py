"""The second scan of a drive, before any velocity is known: where to start, and which start won."""

import numpy as np
from jaxtyping import Float64
from scipy.spatial import cKDTree

from sl3d_slam.geometry.se3 import Points
from sl3d_slam.odometry.surfaces import surfaces_of

START_STEP_M = 2.0
START_DISTANCE_LIMIT_M = 0.5
LYING = 0.7  # z of a normal: the ground, whose rings look the same from everywhere
LEAST_STANDING = 50


def start_positions() -> Float64[np.ndarray, "S 3"]:
    """Return the second scan's starting positions in the frame of the first, standstill first."""
    directions = np.array([[1.0, 0, 0], [-1.0, 0, 0], [0, 1.0, 0], [0, -1.0, 0]])
    return np.vstack([np.zeros(3), START_STEP_M * directions])


def standing_points(points_lidar: Points) -> Float64[np.ndarray, "S 3"]:
    """Return the points on surfaces that stand, by which a step can be told; all if too few do."""
    surfaces = surfaces_of(points_lidar)
    standing = surfaces.points[np.abs(surfaces.normals[:, 2]) < LYING]
    return standing if len(standing) >= LEAST_STANDING else points_lidar


def mean_gap_m(points: Points, first: cKDTree) -> float:
    """Return the mean distance of points to the first scan, each counted up to a limit."""
    gaps_m, _ = first.query(points, distance_upper_bound=START_DISTANCE_LIMIT_M)
    return float(np.minimum(gaps_m, START_DISTANCE_LIMIT_M).mean())

"""A first guess of where a map lies under GPS positions, with up to half of them wrong."""

import numpy as np
from jaxtyping import Float64

from sl3d_slam.errors import GraphError
from sl3d_slam.geometry.se3 import Points, Transform, from_yaw, transform_points

NUM_TRIALS = 400
MIN_SPAN_SIGMAS = 4.0


def align_yaw(
    points_map: Points, points_enu: Points, sigmas_m: Float64[np.ndarray, "N 3"]
) -> Transform:
    """Return ``T_enu_map`` that turns about the vertical: least median of distances.

    Each trial takes two fixes; that with the smallest median distance wins, and its nearer half is
    fitted once more. Seeded, so two runs agree.

    Raises
    ------
    GraphError
        where the fixes span too little ground to tell the heading.
    """
    sigma_m = float(np.median(sigmas_m[:, :2]))
    spread = np.linalg.norm(points_map[:, :2] - np.median(points_map[:, :2], axis=0), axis=1)
    span_m = 2.0 * float(spread.max(initial=0.0))
    if len(points_map) < 3 or span_m < MIN_SPAN_SIGMAS * sigma_m:
        raise GraphError(
            f"{len(points_map)} GPS fixes over {span_m:.0f} m with sigmas of {sigma_m:.1f} m do "
            "not tell the map's heading; expected more of them over a longer drive"
        )
    rng = np.random.default_rng(0)
    best, least_m = np.eye(4), np.inf
    for first, second in rng.integers(0, len(points_map), (NUM_TRIALS, 2)):
        chosen = np.array([first, second])
        if np.linalg.norm(np.diff(points_map[chosen, :2], axis=0)) < 0.25 * span_m:
            continue
        T_enu_map = _fit(points_map[chosen], points_enu[chosen])
        median_m = float(np.median(_distances_m(T_enu_map, points_map, points_enu)))
        if median_m < least_m:
            best, least_m = T_enu_map, median_m
    near = _distances_m(best, points_map, points_enu) <= least_m
    return _fit(points_map[near], points_enu[near]) if near.sum() >= 2 else best


def _fit(points_map: Points, points_enu: Points) -> Transform:
    """Return the yaw and shift with the least squared distances."""
    mean_map, mean_enu = points_map.mean(axis=0), points_enu.mean(axis=0)
    a, b = (points_map - mean_map)[:, :2], (points_enu - mean_enu)[:, :2]
    yaw_rad = np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum())
    T_enu_map = from_yaw(float(yaw_rad), np.zeros(3))
    T_enu_map[:3, 3] = mean_enu - T_enu_map[:3, :3] @ mean_map
    return T_enu_map


def _distances_m(
    T_enu_map: Transform, points_map: Points, points_enu: Points
) -> Float64[np.ndarray, "N"]:
    return np.linalg.norm(transform_points(T_enu_map, points_map) - points_enu, axis=1)

"""What the sensor sees beside an edge: the occlusion test; compiled."""

from typing import no_type_check

import numpy as np
from numba import njit

AZIMUTH_BINS = 1440
ELEVATION_BINS = 90


@njit(cache=True, nogil=True)
@no_type_check
def nearest_ranges(points_lidar: np.ndarray, R_level_lidar: np.ndarray) -> np.ndarray:
    """Return the nearest horizontal range per azimuth (0.25 deg) and elevation (1 deg) bin.

    Azimuth, elevation and range are those of the level frame.
    """
    R = R_level_lidar
    image = np.full((AZIMUTH_BINS, ELEVATION_BINS), np.inf)
    for i in range(len(points_lidar)):
        px, py, pz = points_lidar[i, 0], points_lidar[i, 1], points_lidar[i, 2]
        x = R[0, 0] * px + R[0, 1] * py + R[0, 2] * pz
        y = R[1, 0] * px + R[1, 1] * py + R[1, 2] * pz
        z = R[2, 0] * px + R[2, 1] * py + R[2, 2] * pz
        planar = np.sqrt(x * x + y * y)
        azimuth = int((np.arctan2(y, x) + np.pi) * (AZIMUTH_BINS / (2 * np.pi))) % AZIMUTH_BINS
        elevation = _elevation_bin(planar, z)
        image[azimuth, elevation] = min(image[azimuth, elevation], planar)
    return image


@njit(cache=True)
@no_type_check
def _elevation_bin(planar: float, z: float) -> int:
    elevation = int(np.floor(np.degrees(np.arctan2(z, planar)))) + ELEVATION_BINS // 2
    return min(max(elevation, 0), ELEVATION_BINS - 1)


@njit(cache=True)
@no_type_check
def hidden_share(
    image: np.ndarray, points: np.ndarray, azimuth_from: float, azimuth_to: float, margin_m: float
) -> float:
    """Return the share of an edge's points beside which something nearer is seen.

    The view beside the edge is the azimuth interval given (radians, from the edge outwards); a bin
    at the elevation of a point is nearer when its range is less by more than ``margin_m``.
    """
    scale = AZIMUTH_BINS / (2 * np.pi)
    sign = 1 if azimuth_to > azimuth_from else -1
    first = int(np.floor((azimuth_from + np.pi) * scale))
    steps = max(int(np.ceil(abs(azimuth_to - azimuth_from) * scale)), 2)
    hidden = 0
    for i in range(len(points)):
        planar = np.sqrt(points[i, 0] ** 2 + points[i, 1] ** 2)
        elevation = _elevation_bin(planar, points[i, 2])
        for step in range(steps):
            if image[(first + sign * step) % AZIMUTH_BINS, elevation] < planar - margin_m:
                hidden += 1
                break
    return hidden / max(len(points), 1)

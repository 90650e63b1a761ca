"""Latitude, longitude and height to metres east, north and up of an origin (WGS84)."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from sl3d_slam.geometry.se3 import Points, Transform

SEMI_MAJOR_M = 6_378_137.0
FLATTENING = 1.0 / 298.257223563
ECCENTRICITY_SQUARED = FLATTENING * (2.0 - FLATTENING)


@dataclass(frozen=True, slots=True)
class GeoOrigin:
    """Where east, north and up are zero; ``altitude_m`` is above the ellipsoid, as given."""

    latitude_deg: float
    longitude_deg: float
    altitude_m: float


@dataclass(frozen=True, slots=True, eq=False)
class GeoReference:
    """Where a map lies on the Earth: ``p_enu = T_enu_map @ p_map``.

    ``origin`` is None where the positions came in metres, in a frame of their own.
    """

    T_enu_map: Transform
    origin: GeoOrigin | None


def enu_from_geodetic(
    latitude_deg: Float64[np.ndarray, "N"],
    longitude_deg: Float64[np.ndarray, "N"],
    altitude_m: Float64[np.ndarray, "N"],
    origin: GeoOrigin,
) -> Points:
    """Return metres east, north and up of the origin, by way of Earth-centred coordinates."""
    phi, lam = np.radians(np.array([origin.latitude_deg, origin.longitude_deg]))
    east = [-np.sin(lam), np.cos(lam), 0.0]
    north = [-np.sin(phi) * np.cos(lam), -np.sin(phi) * np.sin(lam), np.cos(phi)]
    up = [np.cos(phi) * np.cos(lam), np.cos(phi) * np.sin(lam), np.sin(phi)]
    centre = _earth_centred(*(np.array([x]) for x in (phi, lam, origin.altitude_m)))
    points = _earth_centred(np.radians(latitude_deg), np.radians(longitude_deg), altitude_m)
    return (points - centre) @ np.array([east, north, up]).T


def _earth_centred(phi: np.ndarray, lam: np.ndarray, altitude_m: np.ndarray) -> np.ndarray:
    radius_m = SEMI_MAJOR_M / np.sqrt(1.0 - ECCENTRICITY_SQUARED * np.sin(phi) ** 2)
    across_m = (radius_m + altitude_m) * np.cos(phi)
    along_m = (radius_m * (1.0 - ECCENTRICITY_SQUARED) + altitude_m) * np.sin(phi)
    return np.stack([across_m * np.cos(lam), across_m * np.sin(lam), along_m], axis=-1)

"""Shapes as a spinning sensor samples them: in rings, dense along a ring and sparse across."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from sl3d_slam.geometry.se3 import Points

SENSOR_HEIGHT_M = (1.0, 2.5)
SENSOR_RANGE_M = 25.0
SPACING_DEG = (0.3, 1.4)
RING_WIDTH = 0.16


@dataclass(frozen=True, slots=True, eq=False)
class ScanRings:
    """The rings of a virtual sensor: where it stands (3,), the angle between two rings."""

    origin: Float64[np.ndarray, "3"]
    spacing_rad: float

    def hit(self, points: Points) -> Bool[np.ndarray, "N"]:
        """Tell which points lie on a ring, a sixth of them."""
        offset = points - self.origin
        elevation = np.arctan2(offset[:, 2], np.hypot(offset[:, 0], offset[:, 1]))
        return np.mod(elevation / self.spacing_rad, 1.0) < RING_WIDTH


def random_rings(centre: Float64[np.ndarray, "3"], rng: np.random.Generator) -> ScanRings:
    """Return the rings of an HDL-64E, an HDL-32E or something between, somewhere around a place."""
    shift = rng.uniform(-SENSOR_RANGE_M, SENSOR_RANGE_M, 2)
    origin = centre + np.append(shift, rng.uniform(*SENSOR_HEIGHT_M))
    spacing_deg = np.exp(rng.uniform(*np.log(SPACING_DEG)))
    return ScanRings(origin, float(np.radians(spacing_deg)))

"""Beam patterns and noise of three spinning lidars."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from sl3d_slam.errors import InputError

SENSOR_NAMES = ("hdl64", "hdl32", "os1-128")


@dataclass(frozen=True, slots=True, eq=False)
class Sensor:
    """A spinning lidar.

    Attributes
    ----------
    name : as on the command line.
    elevations_rad : (B,) of the beams, highest first.
    azimuth_steps : rays of each beam in a turn.
    range_noise_m : standard deviation of a range.
    lost_share : share of the returns that get lost for no reason.
    detection_threshold : reflectivity * cos(incidence) / range^2 below which nothing comes back.
    """

    name: str
    elevations_rad: Float64[np.ndarray, "B"]
    azimuth_steps: int
    min_range_m: float = 1.0
    max_range_m: float = 120.0
    range_noise_m: float = 0.02
    lost_share: float = 0.015
    detection_threshold: float = 1.2e-6

    def directions(self, phase: float) -> Float64[np.ndarray, "R 3"]:
        """Return the unit directions of a sweep, beam by beam, each anticlockwise from ``phase``.

        ``phase`` is in steps; the sensor does not start at the same azimuth twice.
        """
        azimuth = 2 * np.pi * (np.arange(self.azimuth_steps) + phase) / self.azimuth_steps
        cos = np.cos(self.elevations_rad)[:, None]
        sin = np.broadcast_to(np.sin(self.elevations_rad)[:, None], (len(cos), len(azimuth)))
        rows = np.stack([cos * np.cos(azimuth), cos * np.sin(azimuth), sin], axis=2)
        return rows.reshape(-1, 3)


def sensor_named(name: str) -> Sensor:
    """Return ``hdl64``, ``hdl32`` or ``os1-128``.

    ``hdl64``: 32 beams every 1/3 deg from +2 deg, 32 every 1/2 deg down to -24.33 (Velodyne's
    data sheet); ``hdl32``: every 4/3 deg from +10.67; ``os1-128``: evenly between +-22.5 deg.

    Raises
    ------
    InputError
        for any other name.
    """
    match name:
        case "hdl64":
            upper, lower = 2.0 - np.arange(32) / 3.0, -8.83 - 0.5 * np.arange(32)
            return Sensor(name, np.radians(np.concatenate([upper, lower])), 1950)
        case "hdl32":
            return Sensor(name, np.radians(10.67 - np.arange(32) * 41.34 / 31), 2170)
        case "os1-128":
            return Sensor(name, np.radians(np.linspace(22.5, -22.5, 128)), 1024)
        case _:
            raise InputError(f"sensor {name!r}: expected one of {', '.join(SENSOR_NAMES)}")

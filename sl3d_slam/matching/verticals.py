"""Standing lines seen from above: the part of a line set that survives every change of view.

Global matching works on *levelled* frames, where the up direction is z. There a standing line is
a point of the plane with a height interval, and the pose left to find is a yaw and a shift.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Int64

from sl3d_slam.geometry.se3 import Transform, make_transform, rotation_between
from sl3d_slam.geometry.segments import angles_rad, directions, lengths_m, transform_segments
from sl3d_slam.types import LineSet

MAX_TILT_RAD = np.radians(25.0)


@dataclass(frozen=True, slots=True, eq=False)
class Verticals:
    """The standing lines of one line set in its levelled frame.

    Attributes
    ----------
    xy : (V, 2) metres, where each line meets the height of the sensor.
    heights : (V, 2) metres, lower and upper end.
    weights : (V,) how much each line counts.
    descriptors : (V, D) unit length, or D = 0.
    indices : (V,) rows of the line set.
    """

    xy: Float64[np.ndarray, "V 2"]
    heights: Float64[np.ndarray, "V 2"]
    weights: Float64[np.ndarray, "V"]
    descriptors: Float32[np.ndarray, "V D"]
    indices: Int64[np.ndarray, "V"]

    def __len__(self) -> int:
        """Return the number of standing lines."""
        return len(self.xy)


def up_of_lines(lines: LineSet) -> Float64[np.ndarray, "3"]:
    """Return the way up that lines come with, or else the direction that most share, by length.

    Of those near z; z without any. The way up for a line set that comes without its cloud.
    """
    if lines.up is not None:
        return lines.up
    axes = directions(lines.endpoints)
    axes = axes * np.where(axes[:, 2:] < 0, -1.0, 1.0)
    near = axes[:, 2] > np.cos(MAX_TILT_RAD)
    if not near.any():
        return np.array([0.0, 0.0, 1.0])
    axes, weights = axes[near], lengths_m(lines.endpoints)[near]
    agree = angles_rad(axes, axes) < np.radians(4.0)
    best = agree[np.argmax(agree @ weights)]
    mean = (axes[best] * weights[best, None]).sum(axis=0)
    return mean / np.linalg.norm(mean)


def levelling(up_lidar: Float64[np.ndarray, "3"]) -> Transform:
    """Return ``T_level_lidar``, the smallest turn that takes the up direction to z."""
    return make_transform(rotation_between(up_lidar, np.array([0.0, 0.0, 1.0])), np.zeros(3))


def find_verticals(lines: LineSet, T_level_lidar: Transform, max_angle_rad: float) -> Verticals:
    """Keep the lines within an angle of the vertical and express them in the levelled frame."""
    endpoints = transform_segments(T_level_lidar, lines.endpoints)
    axes = directions(endpoints)
    indices = np.flatnonzero(np.abs(axes[:, 2]) > np.cos(max_angle_rad))
    low, high = _by_height(endpoints[indices])
    fraction = _fraction_at_sensor_height(low[:, 2], high[:, 2])
    xy = low[:, :2] + fraction[:, None] * (high[:, :2] - low[:, :2])
    return Verticals(
        xy=xy,
        heights=np.stack([low[:, 2], high[:, 2]], axis=1),
        weights=lines.scores[indices].astype(np.float64),
        descriptors=lines.descriptors[indices],
        indices=indices.astype(np.int64),
    )


def _by_height(endpoints: Float64[np.ndarray, "L 2 3"]) -> tuple[np.ndarray, np.ndarray]:
    swap = endpoints[:, 0, 2] > endpoints[:, 1, 2]
    low = np.where(swap[:, None], endpoints[:, 1], endpoints[:, 0])
    high = np.where(swap[:, None], endpoints[:, 0], endpoints[:, 1])
    return low, high


def _fraction_at_sensor_height(low_z: np.ndarray, high_z: np.ndarray) -> np.ndarray:
    """Return where between its ends a line is nearest to z = 0; no extrapolation."""
    return np.clip(-low_z / np.maximum(high_z - low_z, 1e-6), 0.0, 1.0)

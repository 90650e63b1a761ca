"""Does one scan see through what the other saw? The test that a wrong place does not pass.

A coarse range image keeps, for each direction, the nearest return. A point of the other scan that
lies well in front of it stands in space which the first sensor saw to be empty: a contradiction.
One that lies at it agrees. One behind it is hidden and says nothing.
"""

from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Float32, Float64
from numba import njit

from sl3d_slam.geometry.se3 import Transform, transform_points

AZIMUTH_BINS = 240
ELEVATION_BINS = 40
MIN_ELEVATION_RAD = np.radians(-28.0)
MAX_ELEVATION_RAD = np.radians(24.0)
MARGIN_M = 1.0
MARGIN_PER_M = 0.04
MIN_RANGE_M = 3.0

RangeImage = Float32[np.ndarray, "A E 2"]


@dataclass(frozen=True, slots=True)
class Visibility:
    """How many points agree with the other scan's range image, and how many contradict it."""

    agree: int
    contradict: int

    @property
    def share(self) -> float:
        """Return agreements over all points that say something; 0 where none does."""
        return self.agree / max(1, self.agree + self.contradict)

    def __add__(self, other: "Visibility") -> "Visibility":
        """Count both."""
        return Visibility(self.agree + other.agree, self.contradict + other.contradict)


def range_image(points_level: Float64[np.ndarray, "N 3"]) -> RangeImage:
    """Return the nearest and the farthest range per direction; inf and 0 where nothing returned."""
    return _range_image(points_level)


def compare(
    image_target: RangeImage,
    points_source: Float64[np.ndarray, "N 3"],
    T_target_source: Transform,
) -> Visibility:
    """Hold the source's points against the target's range image; both in levelled frames."""
    agree, contradict = _compare(image_target, transform_points(T_target_source, points_source))
    return Visibility(int(agree), int(contradict))


@njit(cache=True, nogil=True)
@no_type_check
def _cell(x: float, y: float, z: float) -> tuple[int, int, float]:
    flat = np.sqrt(x * x + y * y)
    elevation = np.arctan2(z, flat)
    row = int(
        (elevation - MIN_ELEVATION_RAD) / (MAX_ELEVATION_RAD - MIN_ELEVATION_RAD) * ELEVATION_BINS
    )
    column = int((np.arctan2(y, x) + np.pi) / (2.0 * np.pi) * AZIMUTH_BINS) % AZIMUTH_BINS
    if elevation < MIN_ELEVATION_RAD or row >= ELEVATION_BINS:
        row = -1
    return column, row, np.sqrt(flat * flat + z * z)


@njit(cache=True, nogil=True)
@no_type_check
def _range_image(points: np.ndarray) -> np.ndarray:
    image = np.empty((AZIMUTH_BINS, ELEVATION_BINS, 2), np.float32)
    image[:, :, 0] = np.inf
    image[:, :, 1] = 0.0
    for i in range(len(points)):
        column, row, range_m = _cell(points[i, 0], points[i, 1], points[i, 2])
        if row >= 0 and range_m > MIN_RANGE_M:
            image[column, row, 0] = min(image[column, row, 0], range_m)
            image[column, row, 1] = max(image[column, row, 1], range_m)
    return image


@njit(cache=True, nogil=True)
@no_type_check
def _compare(image: np.ndarray, points: np.ndarray) -> tuple[int, int]:
    agree, contradict = 0, 0
    for i in range(len(points)):
        column, row, range_m = _cell(points[i, 0], points[i, 1], points[i, 2])
        if row < 0 or range_m < MIN_RANGE_M or not np.isfinite(image[column, row, 0]):
            continue
        margin = MARGIN_M + MARGIN_PER_M * range_m
        if range_m < image[column, row, 0] - margin:
            contradict += 1
        elif range_m < image[column, row, 1] + margin:
            agree += 1
    return agree, contradict

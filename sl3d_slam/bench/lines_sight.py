"""Which lines a scan can see: within reach, inside the field of view, not behind something."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64

from sl3d_slam.geometry.se3 import Points
from sl3d_slam.geometry.segments import Segments, lengths_m

SEEN_RANGE_M = 40.0
SEEN_LENGTH_M = 1.0
SEEN_SHARE = 0.8  # of a line that is shorter than 1.25 m
STEP_M = 0.1
MARGIN_M, MARGIN_SHARE = 0.5, 0.02
AZIMUTH_BINS = 1440
ELEVATION_BIN_DEG, LOWEST_DEG, HIGHEST_DEG = 0.5, -45.0, 45.0
NUM_ELEVATIONS = int((HIGHEST_DEG - LOWEST_DEG) / ELEVATION_BIN_DEG)


@dataclass(frozen=True, slots=True, eq=False)
class Sight:
    """How far a scan looks in each direction of its lidar frame.

    Attributes
    ----------
    nearest_m : nearest return by azimuth (0.25 deg) and elevation (0.5 deg); inf where none came.
    lowest_deg, highest_deg : the field of view: elevations of all but one return in a thousand at
        either end.
    """

    nearest_m: Float32[np.ndarray, "A E"]
    lowest_deg: float
    highest_deg: float


def sight_of(points_lidar: Points) -> Sight:
    """Look at a scan in all directions."""
    azimuths, elevations_deg, ranges_m = _spherical(points_lidar)
    nearest_m = np.full((AZIMUTH_BINS, NUM_ELEVATIONS), np.inf, np.float32)
    np.minimum.at(nearest_m, (azimuths, _elevation_bins(elevations_deg)), ranges_m)
    lowest_deg, highest_deg = np.percentile(elevations_deg, [0.1, 99.9])
    return Sight(nearest_m, float(lowest_deg), float(highest_deg))


def is_seen(sight: Sight, endpoints_lidar: Segments) -> Bool[np.ndarray, "L"]:
    """Tell which lines a scan can see.

    A line is walked in steps of 0.1 m. A step is in view when it is within 40 m, inside the field
    of view, and the nearest return in its direction is not nearer than itself by more than 0.5 m
    and 2 % of the range. A line is seen when 1 m of it is in view, or four fifths of a shorter one.
    Nothing need have been returned by it: a line that is not there is "seen" all the same.
    """
    lengths = lengths_m(endpoints_lidar)
    counts = np.maximum(np.ceil(lengths / STEP_M).astype(int), 1)
    line = np.repeat(np.arange(len(counts)), counts)
    place = np.arange(len(line)) - np.repeat(np.cumsum(counts) - counts, counts)
    share = (place + 0.5) / counts[line]
    start, end = endpoints_lidar[line, 0], endpoints_lidar[line, 1]
    visible = _in_view(sight, start + share[:, None] * (end - start))
    visible_m = np.bincount(line, visible, len(counts)) / counts * lengths
    return visible_m >= np.minimum(SEEN_LENGTH_M, SEEN_SHARE * lengths) - 1e-9


def _in_view(sight: Sight, points_lidar: Points) -> Bool[np.ndarray, "N"]:
    azimuths, elevations_deg, ranges_m = _spherical(points_lidar)
    nearest_m = sight.nearest_m[azimuths, _elevation_bins(elevations_deg)]
    hidden = nearest_m < ranges_m - MARGIN_M - MARGIN_SHARE * ranges_m
    inside = (elevations_deg >= sight.lowest_deg) & (elevations_deg <= sight.highest_deg)
    return inside & ~hidden & (ranges_m <= SEEN_RANGE_M)


def _spherical(
    points: Points,
) -> tuple[np.ndarray, Float64[np.ndarray, "N"], Float64[np.ndarray, "N"]]:
    """Return the azimuth bin, the elevation in degrees and the range in metres."""
    x, y, z = points.T
    azimuths = np.floor(np.arctan2(y, x) / (2 * np.pi) * AZIMUTH_BINS).astype(int) % AZIMUTH_BINS
    return azimuths, np.degrees(np.arctan2(z, np.hypot(x, y))), np.linalg.norm(points, axis=1)


def _elevation_bins(elevations_deg: Float64[np.ndarray, "N"]) -> np.ndarray:
    bins = np.floor((elevations_deg - LOWEST_DEG) / ELEVATION_BIN_DEG).astype(int)
    return np.clip(bins, 0, NUM_ELEVATIONS - 1)

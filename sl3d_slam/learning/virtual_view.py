"""One scan as it would have been seen from two places beside: the same street, other shadows.

A single scan has no second view to learn descriptors from. Moving the sensor hides what would then
stand behind something, and thins what would be farther away; what was hidden before stays unknown.
"""

import numpy as np
from jaxtyping import Bool, Float64

from sl3d_slam.geometry.se3 import Points, Transform, make_transform
from sl3d_slam.learning.prepared import PreparedScan

BIN_RAD = np.radians(2.0)  # wide enough that voxels of a wall at 10 m leave no holes in it
MARGIN_M, MARGIN_PER_M = 1.0, 0.04
MIN_RANGE_M = 1.5
DENSE_M = 40.0  # up to where a 64-beam sensor fills every voxel of an upright thing
MAX_ASIDE_M = 2.0


def draw_places(wanted_m: float, rng: np.random.Generator) -> Float64[np.ndarray, "2 3"]:
    """Draw two places at about a distance, along the way that the vehicle drove (its x axis)."""
    along = 0.5 * wanted_m * np.array([1.0, -1.0]) * rng.choice([-1.0, 1.0])
    aside = rng.uniform(-MAX_ASIDE_M, MAX_ASIDE_M, 2)
    return np.stack([along, aside, np.zeros(2)], axis=1)


def two_views(
    scan: PreparedScan, places: Float64[np.ndarray, "2 3"], rng: np.random.Generator
) -> tuple[tuple[PreparedScan, PreparedScan], Transform]:
    """Return a scan as seen from two places, and ``T_first_second`` between them."""
    first, second = (seen_from(scan, place, rng) for place in places)
    return (first, second), make_transform(np.eye(3), places[1] - places[0])


def seen_from(
    scan: PreparedScan, place: Float64[np.ndarray, "3"], rng: np.random.Generator
) -> PreparedScan:
    """Return what of a scan is seen from a place of its frame; lines keep their rows."""
    moved = scan.points[:, :3] - place
    before_m, after_m = np.linalg.norm(scan.points[:, :3], axis=1), np.linalg.norm(moved, axis=1)
    density = np.maximum(before_m, DENSE_M) / np.maximum(after_m, DENSE_M)
    kept = _visible(moved, after_m) & (rng.random(len(moved)) < density)
    points = np.column_stack([moved, scan.points[:, 3]])[kept].astype(np.float32)
    endpoints = (scan.endpoints - place).astype(np.float32)
    return PreparedScan(points, scan.line_ids[kept], endpoints, scan.kinds)


def _visible(points: Points, ranges_m: Float64[np.ndarray, "M"]) -> Bool[np.ndarray, "M"]:
    """Tell which points have nothing well in front of them."""
    azimuth = np.arctan2(points[:, 1], points[:, 0]) + np.pi
    elevation = np.arcsin(points[:, 2] / np.maximum(ranges_m, 1e-6)) + 0.5 * np.pi
    size = int(np.ceil(2.0 * np.pi / BIN_RAD)) + 1
    direction = (azimuth / BIN_RAD).astype(np.int64) * size + (elevation / BIN_RAD).astype(np.int64)
    nearest_m = np.full(size * size, np.inf)
    np.minimum.at(nearest_m, direction, ranges_m)
    limit_m = nearest_m[direction] * (1.0 + MARGIN_PER_M) + MARGIN_M
    return (ranges_m < limit_m) & (ranges_m > MIN_RANGE_M)

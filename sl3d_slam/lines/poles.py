"""Standing poles, posts and trunks: narrow columns with free space around."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from sl3d_slam.geometry.se3 import Points
from sl3d_slam.lines.fit import axis_behind, fit_upright
from sl3d_slam.lines.scene import Scene, vertical_gap_m
from sl3d_slam.lines.structure import MIN_CORE_BINS
from sl3d_slam.lines.view import hidden_share

MAX_RING_SHARE = 0.5
JOIN_RADIUS_M = 0.35
MAX_RADIUS_M = 0.45


@dataclass(frozen=True, slots=True, eq=False)
class Upright:
    """A standing line in the level frame and what was measured of it."""

    endpoints: Float64[np.ndarray, "2 3"]
    num_points: int
    thickness_m: float
    bottom_m: float
    top_m: float
    score: float


def find_poles(scene: Scene, min_length_m: float) -> list[Upright]:
    """Return the poles of a scene, in the order of their clusters."""
    core, ring = scene.structure[:, 0], scene.structure[:, 1]
    candidates = np.flatnonzero((core >= MIN_CORE_BINS) & (ring <= MAX_RING_SHARE * core))
    labels = _cluster(scene.points[candidates])
    poles = []
    for members in _groups(labels):
        pole = _fit_pole(scene, candidates[members], min_length_m)
        if pole is not None:
            poles.append(pole)
    return poles


def _cluster(points: Points) -> np.ndarray:
    """Join points that are close seen from above and no larger step apart in height."""
    if len(points) == 0:
        return np.zeros(0, np.int64)
    pairs = cKDTree(points[:, :2]).query_pairs(JOIN_RADIUS_M, output_type="ndarray")
    step = np.abs(points[pairs[:, 0], 2] - points[pairs[:, 1], 2])
    pairs = pairs[step <= vertical_gap_m(np.linalg.norm(points[pairs[:, 0]], axis=1))]
    links = coo_matrix((np.ones(len(pairs)), pairs.T), shape=(len(points), len(points)))
    return connected_components(links, directed=False)[1]


def _groups(labels: np.ndarray) -> list[np.ndarray]:
    order = np.argsort(labels, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(labels[order])) + 1) if len(labels) else []


def _fit_pole(scene: Scene, voxels: np.ndarray, min_length_m: float) -> Upright | None:
    if len(voxels) < 3 or np.ptp(scene.points[voxels, 2]) < 0.5 * min_length_m:
        return None
    returns = scene.returns_of(voxels)
    if len(returns) < 5:
        return None
    front, slope = fit_upright(returns)
    axis, radius = axis_behind(front, slope, returns)
    if radius > MAX_RADIUS_M:
        return None
    return _judge(scene, voxels, (axis, slope, radius, len(returns)), min_length_m)


def _judge(
    scene: Scene,
    voxels: np.ndarray,
    fit: tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "2"], float, int],
    min_length_m: float,
) -> Upright | None:
    """Measure a column and refuse what is short, squat or a slit between occluders."""
    axis, slope, radius, num_points = fit
    z, heights = scene.points[voxels, 2], scene.heights[voxels]
    low, high = float(z.min()), float(z.max())
    bottom, top = float(heights.min()), float(heights.max())
    thick_and_low = radius > 0.25 and top < 1.9
    if high - low < min_length_m or thick_and_low or high - low < 3 * radius:
        return None
    if _is_slit(scene, scene.points[voxels], axis, radius):
        return None
    endpoints = np.array(
        [np.r_[axis[:2] + slope * (h - axis[2]), h] for h in (low, high)], dtype=np.float64
    )
    isolation = 1.0 - np.mean(scene.structure[voxels, 1] / scene.structure[voxels, 0])
    length_part = min((high - low) / 3.0, 1.0)
    points_part = min(num_points / 60.0, 1.0)
    slender_part = 1.0 if radius < 0.2 or top > 2.2 else 0.5
    score = (0.2 + 0.4 * length_part + 0.2 * points_part + 0.2 * isolation) * slender_part
    return Upright(endpoints, num_points, radius, bottom, top, float(np.clip(score, 0.0, 1.0)))


def _is_slit(scene: Scene, points: Points, axis: Float64[np.ndarray, "3"], radius: float) -> bool:
    """Tell whether a column is only what is visible between two nearer things."""
    planar = float(np.hypot(axis[0], axis[1]))
    azimuth = float(np.arctan2(axis[1], axis[0]))
    inner, outer = (radius + 0.15) / planar, (radius + 0.5) / planar
    left = hidden_share(scene.ranges, points, azimuth + inner, azimuth + outer, 0.5)
    right = hidden_share(scene.ranges, points, azimuth - inner, azimuth - outer, 0.5)
    return min(left, right) > 0.5

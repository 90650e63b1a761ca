"""From points that belong to lines to the lines: region growing, then one line fit after another.

After Superline3D, section 3.1: points within 0.5 m of each other are one region; a region may
hold several lines, such as the three edges of a corner, so it is emptied line by line.
"""

import numpy as np
from jaxtyping import Bool, Float64, Int64
from pydantic import Field
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from sl3d_slam.config import Settings
from sl3d_slam.geometry.se3 import Points
from sl3d_slam.geometry.segments import distance_to_line_m
from sl3d_slam.learning.thinning import voxel_choice

SETTLING = 3
BESIDE = 2.5

Line = tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "3"]]  # a point on it, its direction


class GrowthSettings(Settings):
    """When points make a line.

    ``radius_m`` joins points to a region; ``reach_m`` is how far a point may lie off the line. Of
    the candidates within two and a half times that, ``min_purity`` must lie on the line:
    candidates all over a surface are no line.
    """

    radius_m: float = Field(default=0.5, gt=0)
    reach_m: float = Field(default=0.2, gt=0)
    min_length_m: float = Field(default=1.0, gt=0)
    min_points: int = Field(default=8, ge=2)
    max_gap_m: float = Field(default=1.0, gt=0)
    min_purity: float = Field(default=0.65, ge=0, le=1)
    thinning_m: float = Field(default=0.12, gt=0)
    trials: int = Field(default=60, ge=1)


def grow_lines(points: Points, settings: GrowthSettings, seed: int = 0) -> np.ndarray:
    """Return the segments (L, 2, 3) that candidate points lie on, the longest region first."""
    rng = np.random.default_rng([seed, len(points)])
    if len(points) < settings.min_points:
        return np.zeros((0, 2, 3))
    thin = points[voxel_choice(points, settings.thinning_m, rng)]
    segments = [
        segment
        for region in regions(thin, settings.radius_m)
        if len(region) >= settings.min_points
        for segment in _lines_of(thin[region], settings, rng)
    ]
    return np.array(segments).reshape(-1, 2, 3)


def regions(points: Points, radius_m: float) -> list[Int64[np.ndarray, "_"]]:
    """Return the groups of points that steps of at most ``radius_m`` connect, largest first."""
    if len(points) == 0:
        return []
    pairs = cKDTree(points).query_pairs(radius_m, output_type="ndarray")
    links = coo_matrix((np.ones(len(pairs)), pairs.T), shape=(len(points), len(points)))
    labels = connected_components(links, directed=False)[1]
    order = np.argsort(labels, kind="stable").astype(np.int64)
    groups = np.split(order, np.flatnonzero(np.diff(labels[order])) + 1)
    return sorted(groups, key=lambda group: -len(group))


def _lines_of(
    points: Points, settings: GrowthSettings, rng: np.random.Generator
) -> list[np.ndarray]:
    """Empty a region: the line that most of the points left lie on, again and again.

    With a line goes all that lies beside it: an edge is as wide as the voxels that show it.
    """
    left, found = points, []
    while len(left) >= settings.min_points:
        line = _settled(left, _best_line(left, settings, rng), settings)
        on_line = longest_run(left, line, settings)
        if len(on_line) < settings.min_points:
            break
        along = (left[on_line] - line[0]) @ line[1]
        low, high = float(along.min()), float(along.max())
        around = np.count_nonzero(_beside(points, line, (low, high), settings))
        pure = len(on_line) >= settings.min_purity * around
        if pure and high - low >= settings.min_length_m:
            found.append(line[0] + np.array([[low], [high]]) * line[1])
        left = left[~_beside(left, line, (low, high), settings)]
    return found


def _beside(
    points: Points, line: Line, span: tuple[float, float], settings: GrowthSettings
) -> Bool[np.ndarray, "N"]:
    """Tell which points lie along a stretch of a line or closely beside it."""
    along = (points - line[0]) @ line[1]
    near = distance_to_line_m(points, *line) < BESIDE * settings.reach_m
    return near & (along >= span[0]) & (along <= span[1])


def _settled(points: Points, line: Line, settings: GrowthSettings) -> Line:
    """Fit a line to the points around it, the less a point counts the farther it is off."""
    for _ in range(SETTLING):
        distance = distance_to_line_m(points, *line)
        near = longest_run(points, line, settings)
        weights = 1.0 / (1.0 + (distance[near] / (0.5 * settings.reach_m)) ** 2)
        line = _fitted(points[near], weights)
    return line


def _best_line(points: Points, settings: GrowthSettings, rng: np.random.Generator) -> Line:
    """Return the line through two points that most points lie on."""
    pairs = rng.integers(len(points), size=(settings.trials, 2))
    along = points[pairs[:, 1]] - points[pairs[:, 0]]
    length = np.linalg.norm(along, axis=1)
    far = length > 2.0 * settings.reach_m
    if not far.any():
        return _fitted(points)
    origins, directions = points[pairs[far, 0]], along[far] / length[far, None]
    offset = points[None] - origins[:, None]
    lengthwise = np.einsum("tnd,td->tn", offset, directions)
    squared = np.einsum("tnd,tnd->tn", offset, offset) - lengthwise**2
    count = (squared < settings.reach_m**2).sum(axis=1)
    best = int(count.argmax())
    near = np.flatnonzero(squared[best] < settings.reach_m**2)
    return _fitted(points[near])


def _fitted(points: Points, weights: Float64[np.ndarray, "N"] | None = None) -> Line:
    """Return the least-squares line."""
    origin = np.average(points, axis=0, weights=weights)
    centred = points - origin
    if weights is not None:
        centred = centred * np.sqrt(weights)[:, None]
    return origin, np.linalg.svd(centred, full_matrices=False)[2][0]


def longest_run(points: Points, line: Line, settings: GrowthSettings) -> Int64[np.ndarray, "_"]:
    """Return the points near a line, of its densest stretch without a gap."""
    near = np.flatnonzero(distance_to_line_m(points, *line) < settings.reach_m)
    along = (points[near] - line[0]) @ line[1]
    order = np.argsort(along)
    breaks = np.flatnonzero(np.diff(along[order]) > settings.max_gap_m) + 1
    return near[max(np.split(order, breaks), key=len)]

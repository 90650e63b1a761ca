"""Standing lines grown from the points that the network calls lines, fitted on the full scan."""

import numpy as np
from jaxtyping import Float, Float32, Float64, Int64
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from sl3d_slam.lines.fit import axis_behind, fit_upright
from sl3d_slam.lines.poles import MAX_RADIUS_M, Upright
from sl3d_slam.lines.scene import Scene, vertical_gap_m
from sl3d_slam.lines.wall_fit import meeting_of_walls
from sl3d_slam.types import LineKind

MIN_PROBABILITY = 0.3
JOIN_RADIUS_M = 0.5
MIN_POINTS = 3
COLUMN_M = 0.45
RING_M = 0.9
MAX_RING_SHARE = 0.5
CORNER_REACH_M = 0.5
SHEET_REACH_M = 1.2
MAX_THICKNESS_M = 0.1
MIN_SHEET_VOXELS = 8
MIN_CORNER_SINE = 0.5
MAX_FIT_SCORE = 0.3
FULL_LENGTH_M = 3.0
FILL_M = 0.6


def grow_uprights(
    scene: Scene,
    points: Float32[np.ndarray, "M 4"],
    probability: Float32[np.ndarray, "M"],
    min_length_m: float,
    taken: Float64[np.ndarray, "L 2"] = np.zeros((0, 2)),  # noqa: B008  (never written)
) -> list[tuple[Upright, LineKind]]:
    """Return the standing lines that confident points form, with what they stand on.

    Points above a probability of 0.3 (a group that agrees is likelier than each of its points) are
    joined within 0.5 m seen from above and with no larger gap in height than beams leave. What
    stands free is fitted as a pole; else the line is where the two wall planes beside it meet, or,
    without two, where the confident points stand. Places within 0.6 m of those ``taken``, seen from
    above, are left alone.
    """
    confident = np.flatnonzero(probability > MIN_PROBABILITY)
    found = []
    for members in _join(points[confident, :3].astype(np.float64)):
        rows = confident[members]
        if not _is_free(points[rows, :2].mean(axis=0), taken):
            continue  # most groups: bits of what geometry found
        line = _fit(scene, points[rows].astype(np.float64), probability[rows], min_length_m)
        if line is not None and _is_free(line[0].endpoints.mean(axis=0)[:2], taken):
            found.append(line)
    return found


def _is_free(place: Float[np.ndarray, "2"], taken: Float64[np.ndarray, "L 2"]) -> bool:
    return bool(np.linalg.norm(taken - place, axis=1).min(initial=np.inf) > FILL_M)


def _join(points: Float64[np.ndarray, "N 3"]) -> list[Int64[np.ndarray, "_"]]:
    if len(points) == 0:
        return []
    pairs = cKDTree(points[:, :2]).query_pairs(JOIN_RADIUS_M, output_type="ndarray")
    step = np.abs(points[pairs[:, 0], 2] - points[pairs[:, 1], 2])
    pairs = pairs[step <= vertical_gap_m(np.linalg.norm(points[pairs[:, 0]], axis=1))]
    links = coo_matrix((np.ones(len(pairs)), pairs.T), shape=(len(points), len(points)))
    labels = connected_components(links, directed=False)[1]
    order = np.argsort(labels, kind="stable")
    groups = np.split(order, np.flatnonzero(np.diff(labels[order])) + 1)
    return [group for group in groups if len(group) >= MIN_POINTS]


def _fit(
    scene: Scene,
    points: Float64[np.ndarray, "P 4"],
    probability: Float32[np.ndarray, "P"],
    min_length_m: float,
) -> tuple[Upright, LineKind] | None:
    low, high = float(points[:, 2].min()), float(points[:, 2].max())
    if high - low < min_length_m:
        return None
    place = np.average(points[:, :2], axis=0, weights=probability)
    span = (low, high)
    clearance = float(np.median(points[:, 2] - points[:, 3]))
    pole = _as_pole(scene, place, span, clearance)
    if pole is not None:
        return pole, LineKind.POLE
    corner = _corner_near(scene, place, span)
    if corner is not None:
        place = corner
    endpoints = np.array([[*place, low], [*place, high]])
    score = _fit_score(high - low)
    edge = Upright(endpoints, len(points), 0.0, low - clearance, high - clearance, score)
    return edge, LineKind.VERTICAL_EDGE


def _as_pole(
    scene: Scene, place: Float64[np.ndarray, "2"], span: tuple[float, float], ground: float
) -> Upright | None:
    """Fit the axis of a column with free space around, or return None where there is none."""
    near = scene.around(place, RING_M)
    z = scene.points[near, 2]
    near = near[(z > span[0] - 0.2) & (z < span[1] + 0.2)]
    distance = np.linalg.norm(scene.points[near, :2] - place, axis=1)
    core, ring = near[distance < COLUMN_M], near[(distance >= COLUMN_M) & (distance < RING_M)]
    if len(core) < MIN_POINTS or len(ring) > MAX_RING_SHARE * len(core):
        return None
    returns = scene.returns_of(core)
    if len(returns) < 5:
        return None
    front, slope = fit_upright(returns)
    axis, radius = axis_behind(front, slope, returns)
    if radius > MAX_RADIUS_M:
        return None
    low, high = float(scene.points[core, 2].min()), float(scene.points[core, 2].max())
    endpoints = np.array([np.r_[axis[:2] + slope * (h - axis[2]), h] for h in (low, high)])
    score = _fit_score(high - low)
    return Upright(endpoints, len(returns), float(radius), low - ground, high - ground, score)


def _fit_score(length_m: float) -> float:
    """Return a score that puts such lines behind those whose shape geometry vouches for."""
    return MAX_FIT_SCORE * (0.5 + 0.5 * min(length_m / FULL_LENGTH_M, 1.0))


def _corner_near(
    scene: Scene, place: Float64[np.ndarray, "2"], span: tuple[float, float]
) -> Float64[np.ndarray, "2"] | None:
    """Return where two walls within 1.2 m of a place meet, if that is within 0.5 m of it."""
    near = scene.around(place, SHEET_REACH_M)
    z = scene.points[near, 2]
    near = near[(z > span[0]) & (z < span[1]) & (scene.structure[near, 4] < MAX_THICKNESS_M)]
    offset = scene.points[near, :2] - place
    meeting = meeting_of_walls(
        scene.structure[near, 2:4], offset, MIN_SHEET_VOXELS, MIN_CORNER_SINE
    )
    # nowhere is not near
    return place + meeting if np.hypot(meeting[0], meeting[1]) < CORNER_REACH_M else None

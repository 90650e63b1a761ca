"""Lines of one scan with the network: it ranks and describes what is proposed, and adds to it."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32, Float64, Int64
from scipy.spatial import cKDTree

from sl3d_slam.config import LineSettings
from sl3d_slam.geometry.se3 import Points
from sl3d_slam.lines.geometric import find_uprights, to_lidar
from sl3d_slam.lines.grown import grow_uprights
from sl3d_slam.lines.network.inference import Inference, Network
from sl3d_slam.lines.network.sample import network_points
from sl3d_slam.lines.poles import Upright
from sl3d_slam.lines.scene import Scene, make_scene
from sl3d_slam.types import LineKind, LineSet

REACH_M = 0.35
OVERSHOOT_M = 0.2
SAME_LINE_M = 0.4
FILL_M = 0.6
PRIOR_POINTS = 2.0


def learned_lines(points_lidar: Points, settings: LineSettings, network: Network) -> LineSet:
    """Return the lines of a scan that the network believes in most, best first.

    Candidates are what geometry proposes, whose axes are the most precise, and where it proposes
    nothing the segments grown from the points that the network calls lines; all are fitted on the
    full scan. The network then ranks and describes them: by the mean line probability of the points
    along each, times the root of the fit's score, and by their mean descriptor.
    """
    scene = make_scene(points_lidar, settings)
    points = network_points(points_lidar, network.settings)
    points[:, :3] = points[:, :3] @ scene.R_level_lidar.T.astype(np.float32)
    inference = network.infer(points)
    uprights, kinds = _candidates(scene, points, inference.probability, settings)
    endpoints = _segments(uprights)
    members = points_along(endpoints, points)
    fits = np.array([upright.score for upright in uprights])
    scores = np.sqrt(fits) * _mean_probability(members, inference.probability)
    order = _best_apart(endpoints, scores, settings.max_lines)
    return LineSet(
        endpoints=to_lidar(scene, endpoints[order]),
        descriptors=_describe(network, inference, [members[i] for i in order]),
        num_points=np.array([uprights[i].num_points for i in order], np.int64),
        kinds=np.array([kinds[i] for i in order], np.uint8),
        scores=scores[order].astype(np.float32),
    )


def _candidates(
    scene: Scene,
    points: Float32[np.ndarray, "M 4"],
    probability: Float32[np.ndarray, "M"],
    settings: LineSettings,
) -> tuple[list[Upright], list[LineKind]]:
    """Return geometry's lines, and those grown from confident points that none of them explains."""
    uprights, kinds = find_uprights(scene, settings)
    proposed = _segments(uprights)
    unexplained = probability.copy()
    for rows in points_along(proposed, points):
        unexplained[rows] = 0.0
    places = proposed.mean(axis=1)[:, :2]
    for upright, kind in grow_uprights(scene, points, unexplained, settings.min_length_m):
        place = upright.endpoints.mean(axis=0)[:2]
        if np.linalg.norm(places - place, axis=1).min(initial=np.inf) > FILL_M:
            uprights.append(upright)
            kinds.append(kind)
    return uprights, kinds


def _segments(uprights: Sequence[Upright]) -> Float64[np.ndarray, "L 2 3"]:
    return np.array([upright.endpoints for upright in uprights], np.float64).reshape(-1, 2, 3)


def points_along(
    endpoints: Float64[np.ndarray, "L 2 3"], points: Float32[np.ndarray, "M 4"]
) -> list[Int64[np.ndarray, "_"]]:
    """Return for each standing segment the points within 0.35 m beside it."""
    if len(endpoints) == 0 or len(points) == 0:
        return [np.zeros(0, np.int64)] * len(endpoints)
    middle = endpoints.mean(axis=1)
    lean = 0.5 * np.linalg.norm(endpoints[:, 1, :2] - endpoints[:, 0, :2], axis=1)
    near = cKDTree(points[:, :2]).query_ball_point(middle[:, :2], REACH_M + lean)
    return [
        _beside(segment, points, np.sort(np.asarray(rows, np.int64)))
        for segment, rows in zip(endpoints, near, strict=True)
    ]


def _beside(
    segment: Float64[np.ndarray, "2 3"],
    points: Float32[np.ndarray, "M 4"],
    rows: Int64[np.ndarray, "P"],
) -> Int64[np.ndarray, "Q"]:
    low, high = segment[np.argsort(segment[:, 2])]
    z = points[rows, 2]
    share = np.clip((z - low[2]) / max(high[2] - low[2], 1e-6), 0.0, 1.0)[:, None]
    aside = points[rows, :2] - (low[:2] + share * (high[:2] - low[:2]))
    inside = (z > low[2] - OVERSHOOT_M) & (z < high[2] + OVERSHOOT_M)
    return rows[inside & (np.einsum("ij,ij->i", aside, aside) < REACH_M**2)]


def _mean_probability(
    members: list[Int64[np.ndarray, "_"]], probability: Float32[np.ndarray, "M"]
) -> Float64[np.ndarray, "L"]:
    """Return the mean probability along each line, less where few points speak for it."""
    total = np.array([probability[rows].sum(dtype=np.float64) for rows in members])
    return total / (np.array([len(rows) for rows in members]) + PRIOR_POINTS)


def _best_apart(
    endpoints: Float64[np.ndarray, "L 2 3"], scores: Float64[np.ndarray, "L"], max_lines: int
) -> Int64[np.ndarray, "K"]:
    """Return the best lines, best first, leaving out what stands where a better one does."""
    places = endpoints.mean(axis=1)[:, :2]
    low, high = endpoints[:, :, 2].min(axis=1), endpoints[:, :, 2].max(axis=1)
    kept: list[int] = []
    for i in np.argsort(-scores, kind="stable"):
        close = np.linalg.norm(places[kept] - places[i], axis=1) < SAME_LINE_M
        if scores[i] > 0 and not np.any(close & (low[kept] < high[i]) & (low[i] < high[kept])):
            kept.append(int(i))
        if len(kept) == max_lines:
            break
    return np.array(kept, np.int64)


def _describe(
    network: Network, inference: Inference, members: list[Int64[np.ndarray, "_"]]
) -> Float32[np.ndarray, "L D"]:
    """Return the mean descriptor of each line's points, weighted by their probability."""
    means = np.zeros((len(members), network.settings.descriptor_dim), np.float32)
    if len(members) == 0:
        return means
    rows = np.concatenate(members)
    weighted = network.describe(inference, rows) * inference.probability[rows, None]
    line = np.repeat(np.arange(len(members)), [len(points) for points in members])
    np.add.at(means, line, weighted)
    return means / np.maximum(np.linalg.norm(means, axis=1, keepdims=True), 1e-12)

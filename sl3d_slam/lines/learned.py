"""Lines of one scan with the network: it ranks and describes what is proposed, and adds to it."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import chain

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64
from scipy.spatial import cKDTree

from sl3d_slam.config import LineSettings
from sl3d_slam.geometry.se3 import Points
from sl3d_slam.lines.geometric import Proposal, find_uprights, to_lidar
from sl3d_slam.lines.grown import grow_uprights
from sl3d_slam.lines.network.answer import Inference
from sl3d_slam.lines.network.inference import Network
from sl3d_slam.lines.network.sample import network_points
from sl3d_slam.lines.poles import Upright
from sl3d_slam.lines.scene import make_scene
from sl3d_slam.types import LineKind, LineSet

REACH_M = 0.35
OVERSHOOT_M = 0.2
SAME_LINE_M = 0.4
PRIOR_POINTS = 2.0


def learned_lines(points_lidar: Points, settings: LineSettings, network: Network) -> LineSet:
    """Return the lines of a scan that the network believes in most, best first.

    Candidates are what geometry proposes, whose axes are the most precise, and where it proposes
    nothing the segments grown from the points that the network calls lines; all are fitted on the
    full scan. The network then ranks and describes them: by the mean line probability of the points
    along each and the fit's score, which count alike, and by their mean descriptor, in which those
    of the lines around it may take part.
    """
    scene = make_scene(points_lidar, settings)
    points = network_points(scene, network.settings)
    with ThreadPoolExecutor(1) as beside:  # both are compiled for the most part
        proposing = beside.submit(find_uprights, scene, settings)
        inference = network.infer(points)
    proposal = Proposal(scene, *proposing.result())
    return _ranked(proposal, (points, inference), settings, network)


def learned_lines_of(proposal: Proposal, settings: LineSettings, network: Network) -> LineSet:
    """Return what :func:`learned_lines` does of a scan whose proposals are there already."""
    points = network_points(proposal.scene, network.settings)
    return _ranked(proposal, (points, network.infer(points)), settings, network)


def _ranked(
    proposal: Proposal,
    answer: tuple[Float32[np.ndarray, "M 4"], Inference],
    settings: LineSettings,
    network: Network,
) -> LineSet:
    scene, (points, inference) = proposal.scene, answer
    uprights, kinds, members = _candidates(
        proposal, points, inference.probability, settings.min_length_m
    )
    endpoints = _segments(uprights)
    fits = np.array([upright.score for upright in uprights])
    scores = np.sqrt(fits * _mean_probability(members, inference.probability))
    order = _best_apart(endpoints, scores, settings.max_lines)
    means = _describe(inference, [members[i] for i in order], network.settings.descriptor_dim)
    return LineSet(
        endpoints=to_lidar(scene, endpoints[order]),
        descriptors=network.in_surroundings(
            means, endpoints[order].mean(axis=1)[:, :2], scores[order]
        ),
        num_points=np.array([uprights[i].num_points for i in order], np.int64),
        kinds=np.array([kinds[i] for i in order], np.uint8),
        scores=scores[order].astype(np.float32),
        up=scene.up,
        ground_up=scene.ground_up,
    )


def _candidates(
    proposal: Proposal,
    points: Float32[np.ndarray, "M 4"],
    probability: Float32[np.ndarray, "M"],
    min_length_m: float,
) -> tuple[list[Upright], list[LineKind], list[Int64[np.ndarray, "_"]]]:
    """Return geometry's lines, those grown from points that none of them explains, their points."""
    scene, uprights, kinds = proposal
    proposed = _segments(uprights)
    tree = cKDTree(points[:, :2])
    members = points_along(proposed, points, tree)
    unexplained = probability.copy()
    for rows in members:
        unexplained[rows] = 0.0
    taken = proposed.mean(axis=1)[:, :2]
    grown = grow_uprights(scene, points, unexplained, min_length_m, taken)
    added = [upright for upright, _ in grown]
    members += points_along(_segments(added), points, tree)
    return [*uprights, *added], [*kinds, *(kind for _, kind in grown)], members


def _segments(uprights: Sequence[Upright]) -> Float64[np.ndarray, "L 2 3"]:
    return np.array([upright.endpoints for upright in uprights], np.float64).reshape(-1, 2, 3)


def points_along(
    endpoints: Float64[np.ndarray, "L 2 3"],
    points: Float32[np.ndarray, "M 4"],
    tree: cKDTree | None = None,
) -> list[Int64[np.ndarray, "_"]]:
    """Return for each standing segment the points within 0.35 m beside it.

    ``tree`` holds the points seen from above, where that is built already.
    """
    if len(endpoints) == 0 or len(points) == 0:
        return [np.zeros(0, np.int64)] * len(endpoints)
    tree = cKDTree(points[:, :2]) if tree is None else tree
    middle = endpoints.mean(axis=1)
    lean = 0.5 * np.linalg.norm(endpoints[:, 1, :2] - endpoints[:, 0, :2], axis=1)
    near = tree.query_ball_point(middle[:, :2], REACH_M + lean, return_sorted=True)
    line = np.repeat(np.arange(len(near)), [len(rows) for rows in near])
    rows = np.fromiter(chain.from_iterable(near), np.int64, len(line))
    beside = _beside(endpoints[line], points[rows])
    stops = np.cumsum(np.bincount(line[beside], minlength=len(near)))
    return np.split(rows[beside], stops[:-1])


def _beside(
    segments: Float64[np.ndarray, "P 2 3"], points: Float32[np.ndarray, "P 4"]
) -> Bool[np.ndarray, "P"]:
    """Tell which of the points stand along the segment that each is paired with."""
    upward = segments[:, 1, 2] >= segments[:, 0, 2]
    low = np.where(upward[:, None], segments[:, 0], segments[:, 1])
    high = np.where(upward[:, None], segments[:, 1], segments[:, 0])
    z = points[:, 2]
    share = np.clip((z - low[:, 2]) / np.maximum(high[:, 2] - low[:, 2], 1e-6), 0.0, 1.0)
    aside = points[:, :2] - (low[:, :2] + share[:, None] * (high[:, :2] - low[:, :2]))
    inside = (z > low[:, 2] - OVERSHOOT_M) & (z < high[:, 2] + OVERSHOOT_M)
    result: Bool[np.ndarray, P] = inside & (np.einsum("ij,ij->i", aside, aside) < REACH_M**2)
    return result


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
    inference: Inference, members: list[Int64[np.ndarray, "_"]], dimension: int
) -> Float32[np.ndarray, "L D"]:
    """Return the mean descriptor of each line's points, weighted by their probability."""
    means = np.zeros((len(members), dimension), np.float32)
    if len(members) == 0:
        return means
    rows = np.concatenate(members)
    weighted = inference.describe(rows) * inference.probability[rows, None]
    line = np.repeat(np.arange(len(members)), [len(points) for points in members])
    np.add.at(means, line, weighted)
    return means / np.maximum(np.linalg.norm(means, axis=1, keepdims=True), 1e-12)

"""Which observations are of the same line: greedy grouping around the densest ones.

Two lines agree when they lie along one axis: a small angle, a small distance between the axes where
both run, and no long gap between them. An observation with many agreeing ones near it is a good
seed; seeds claim what agrees with them, best first, so that no group is wider than twice the
distance allowed and nothing chains along a row of posts or behind a walker. Groups are then merged
in the same way, by their means, which are better than any single observation.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.spatial import cKDTree

from sl3d_slam.config import MapSettings
from sl3d_slam.geometry.segments import Segments, directions, lengths_m, midpoints

STANDING_DEG = 20.0
LEAN_M = 0.5  # middles of leaning lines lie farther apart than their axes
SAMPLE_M = 1.0


class Pairs(NamedTuple):
    """Rows that agree, each pair in both orders, sorted by ``first``, and their distance."""

    first: Int64[np.ndarray, "P"]
    second: Int64[np.ndarray, "P"]
    distance_m: Float64[np.ndarray, "P"]


def standing(endpoints: Segments, up: Float64[np.ndarray, "L 3"]) -> Bool[np.ndarray, "L"]:
    """Tell which lines point up or down within 20 degrees; ``up`` has a row a line."""
    cosine = np.abs(np.einsum("ij,ij->i", directions(endpoints), up))
    return cosine >= np.cos(np.radians(STANDING_DEG))


def group_lines(
    endpoints: Segments,
    weights: Float64[np.ndarray, "L"],
    is_standing: Bool[np.ndarray, "L"],
    settings: MapSettings,
) -> Int64[np.ndarray, "L"]:
    """Return a group number for each line, counted from 0 by the group's first line.

    ``weights`` say how many observations a row stands for. Ties go to the lower row.
    """
    pairs = agreeing_pairs(endpoints, is_standing, settings)
    kernel = np.exp(-2.0 * (pairs.distance_m / settings.merge_distance_m) ** 2)
    mass = weights[pairs.second] * kernel
    density = weights + np.bincount(pairs.first, weights=mass, minlength=len(weights))
    return _renumbered(_claim(pairs, density))


def agreeing_pairs(
    endpoints: Segments, is_standing: Bool[np.ndarray, "L"], settings: MapSettings
) -> Pairs:
    """Return all pairs of lines that may be one line, standing ones and others apart."""
    upright, other = np.flatnonzero(is_standing), np.flatnonzero(~is_standing)
    reach_m = settings.merge_distance_m + LEAN_M
    candidates = np.concatenate(
        [
            upright[_near_from_above(midpoints(endpoints[upright]), reach_m)],
            other[_near_along(endpoints[other], reach_m + SAMPLE_M / 2)],
        ]
    )
    agree, distance = _agreement(endpoints, candidates, settings)
    kept, distance = candidates[agree], distance[agree]
    both = np.concatenate([kept, kept[:, ::-1]])
    distance = np.concatenate([distance, distance])
    order = np.lexsort((both[:, 1], both[:, 0]))
    return Pairs(both[order, 0], both[order, 1], distance[order])


def _near_from_above(
    places: Float64[np.ndarray, "L 3"], reach_m: float
) -> Int64[np.ndarray, "P 2"]:
    if len(places) == 0:
        return np.zeros((0, 2), np.int64)
    pairs = cKDTree(places[:, :2]).query_pairs(reach_m, output_type="ndarray")
    return pairs.astype(np.int64).reshape(-1, 2)


def _near_along(endpoints: Segments, reach_m: float) -> Int64[np.ndarray, "P 2"]:
    """Return pairs of lines that come near each other anywhere, by samples a metre apart."""
    if len(endpoints) == 0:
        return np.zeros((0, 2), np.int64)
    count = np.ceil(lengths_m(endpoints) / SAMPLE_M).astype(np.int64) + 1
    line = np.repeat(np.arange(len(endpoints)), count)
    step = np.arange(len(line)) - np.repeat(np.cumsum(count) - count, count)
    fraction = (step / np.maximum(count[line] - 1, 1))[:, None]
    samples = endpoints[line, 0] * (1 - fraction) + endpoints[line, 1] * fraction
    pairs = line[cKDTree(samples).query_pairs(reach_m, output_type="ndarray").reshape(-1, 2)]
    pairs = np.sort(pairs[pairs[:, 0] != pairs[:, 1]], axis=1)
    keys = np.unique(pairs[:, 0] * len(endpoints) + pairs[:, 1])
    return np.stack([keys // len(endpoints), keys % len(endpoints)], axis=1)


def _agreement(
    endpoints: Segments, pairs: Int64[np.ndarray, "P 2"], settings: MapSettings
) -> tuple[Bool[np.ndarray, "P"], Float64[np.ndarray, "P"]]:
    """Tell which pairs agree, and the distance of their axes in the middle of where both run."""
    along, middle, length = directions(endpoints), midpoints(endpoints), lengths_m(endpoints)
    i, j = pairs[:, 0], pairs[:, 1]
    cosine = np.einsum("ij,ij->i", along[i], along[j])
    turned = along[j] * np.where(cosine < 0, -1.0, 1.0)[:, None]
    axis = along[i] * length[i, None] + turned * length[j, None]
    axis /= np.maximum(np.linalg.norm(axis, axis=1, keepdims=True), 1e-12)
    apart = middle[j] - middle[i]  # positions along the axis are counted from the first's middle
    shift = np.einsum("ij,ij->i", apart, axis)
    low = np.maximum(-length[i], 2 * shift - length[j]) / 2
    high = np.minimum(length[i], 2 * shift + length[j]) / 2
    at = ((low + high) / 2)[:, None]
    between = apart + turned * (at - shift[:, None]) - along[i] * at
    distance = np.linalg.norm(between, axis=1)
    agree = np.abs(cosine) >= np.cos(np.radians(settings.merge_angle_deg))
    agree &= (low - high <= settings.merge_gap_m) & (distance <= settings.merge_distance_m)
    return agree, distance


def _claim(pairs: Pairs, density: Float64[np.ndarray, "L"]) -> Int64[np.ndarray, "L"]:
    """Let each line, densest first, claim the unclaimed lines that agree with it."""
    starts = np.searchsorted(pairs.first, np.arange(len(density) + 1))
    seed = np.full(len(density), -1, np.int64)
    for row in np.argsort(-density, kind="stable"):
        if seed[row] < 0:
            near = pairs.second[starts[row] : starts[row + 1]]
            seed[near[seed[near] < 0]] = row
            seed[row] = row
    return seed


def _renumbered(labels: Int64[np.ndarray, "L"]) -> Int64[np.ndarray, "L"]:
    """Number groups from 0 in the order in which their first members come."""
    _, first, inverse = np.unique(labels, return_index=True, return_inverse=True)
    rank = np.empty(len(first), np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    return rank[inverse]

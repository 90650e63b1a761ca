"""From the lines of every keyframe to landmarks, and which of them to trust."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.spatial import cKDTree

from sl3d_slam.config import MapSettings
from sl3d_slam.errors import InputError
from sl3d_slam.geometry.segments import midpoints
from sl3d_slam.mapping.landmarks import mean_lines
from sl3d_slam.mapping.merge import group_lines, standing
from sl3d_slam.types import LineSet

MAX_REGROUPINGS = 5
IN_VIEW_M = 20.0


class Observations(NamedTuple):
    """Observed lines in the map frame (or landmarks seen before), a row each.

    ``up`` points up at the row's keyframe, ``weights`` say how many observations a row stands for.
    """

    lines: LineSet
    up: Float64[np.ndarray, "N 3"]
    weights: Float64[np.ndarray, "N"]


class Sightings(NamedTuple):
    """Which keyframe saw which landmark: every pair once, sorted by landmark, then keyframe."""

    landmarks: Int64[np.ndarray, "S"]
    keyframes: Int64[np.ndarray, "S"]


def group_observations(observations: Observations, settings: MapSettings) -> Int64[np.ndarray, "N"]:
    """Return the landmark of each row, numbered from 0 by first row.

    Rows are grouped, then the groups by their means, until no two means agree any more.
    """
    lines, weights = observations.lines, observations.weights
    upright = standing(lines.endpoints, observations.up)
    groups = group_lines(lines.endpoints, weights, upright, settings)
    if len(groups) == 0:
        return groups
    for _ in range(MAX_REGROUPINGS):
        total = np.bincount(groups, weights=weights)
        mean = mean_lines(lines, weights, groups)
        mostly_upright = np.bincount(groups, weights=weights * upright) > total / 2
        merged = group_lines(mean.endpoints, total, mostly_upright, settings)
        groups = merged[groups]
        if merged.max() + 1 == len(mean):
            break
    return groups


def unique_sightings(
    landmarks: Int64[np.ndarray, "N"], keyframes: Int64[np.ndarray, "N"]
) -> Sightings:
    """Count a landmark once a keyframe, even where it was found in two pieces."""
    rows = np.unique(np.stack([landmarks, keyframes], axis=1), axis=0)
    return Sightings(rows[:, 0], rows[:, 1])


def trusted(
    lines: LineSet,
    sightings: Sightings,
    positions: Float64[np.ndarray, "K 3"],
    settings: MapSettings,
) -> Bool[np.ndarray, "L"]:
    """Tell which landmarks were seen often enough, given how often they could have been.

    A landmark's chances are the keyframes no farther from it than the farthest that saw it, and
    those within 20 m in any case. It stays when it was seen ``min_support`` times, or at every
    chance where there were fewer, and at ``min_seen_share`` of its chances. What moved was in view
    for longer than it stood where it was seen; a post glimpsed once where the drive ends had no
    more chances.
    """
    if len(lines) == 0:
        return np.zeros(0, np.bool_)
    place = midpoints(lines.endpoints)[:, :2]
    between = place[sightings.landmarks] - positions[sightings.keyframes, :2]
    farthest_m = np.full(len(lines), IN_VIEW_M)
    np.maximum.at(farthest_m, sightings.landmarks, np.hypot(between[:, 0], between[:, 1]))
    tree = cKDTree(positions[:, :2])
    chances = tree.query_ball_point(place, farthest_m + 1e-6, return_length=True)
    support = np.bincount(sightings.landmarks, minlength=len(lines))
    enough = support >= np.minimum(settings.min_support, chances)
    return enough & (support >= settings.min_seen_share * chances)


def keep_landmarks(
    lines: LineSet, sightings: Sightings, kept: Bool[np.ndarray, "L"]
) -> tuple[LineSet, Sightings]:
    """Drop landmarks and their sightings, and number the rest anew."""
    number = np.cumsum(kept) - 1
    rows = kept[sightings.landmarks]
    return lines.take(kept), Sightings(number[sightings.landmarks[rows]], sightings.keyframes[rows])


def by_keyframe(
    sightings: Sightings, count: int
) -> tuple[Int64[np.ndarray, "O"], Int64[np.ndarray, "S"]]:
    """Return sightings as offsets by keyframe and ascending landmarks."""
    order = np.lexsort((sightings.landmarks, sightings.keyframes))
    offsets = np.searchsorted(sightings.keyframes[order], np.arange(count + 1))
    return offsets.astype(np.int64), sightings.landmarks[order]


def observations_of(
    keyframe_lines: Sequence[LineSet],
    T_map_keyframe: Float64[np.ndarray, "K 4 4"],
    keyframe_up: Float64[np.ndarray, "K 3"],
) -> tuple[Observations, Int64[np.ndarray, "N"]]:
    """Return all lines in the map frame, keyframe after keyframe, and their keyframes."""
    counts = [len(lines) for lines in keyframe_lines]
    keyframes = np.repeat(np.arange(len(counts)), counts).astype(np.int64)
    up = np.einsum("kij,kj->ki", T_map_keyframe[:, :3, :3], keyframe_up)
    moved = [lines.transformed(T) for lines, T in zip(keyframe_lines, T_map_keyframe, strict=True)]
    joined = join_lines(moved)
    return Observations(joined, up[keyframes], np.ones(len(joined))), keyframes


def join_lines(parts: Sequence[LineSet]) -> LineSet:
    """Return the lines of all parts in one set, in order."""
    if not parts:
        return LineSet(np.zeros((0, 2, 3)), np.zeros((0, 0), np.float32), np.zeros(0, np.int64))
    return LineSet(
        endpoints=np.concatenate([part.endpoints for part in parts]),
        descriptors=np.concatenate([part.descriptors for part in parts]),
        num_points=np.concatenate([part.num_points for part in parts]),
        kinds=np.concatenate([part.kinds for part in parts]),
        scores=np.concatenate([part.scores for part in parts]),
    )


def check_counts(
    count: int,
    keyframe_lines: Sequence[LineSet],
    keyframe_up: np.ndarray,
    clouds: Sequence[np.ndarray] | None,
) -> None:
    """Refuse lines, up vectors or clouds that are not as many as the poses.

    Raises
    ------
    InputError
        saying so, or that descriptors are of different lengths.
    """
    found = [len(keyframe_lines), len(keyframe_up), count if clouds is None else len(clouds)]
    if any(number != count for number in found):
        raise InputError(f"a map of {count} poses needs lines, up vectors and clouds of each")
    if len({lines.descriptors.shape[1] for lines in keyframe_lines}) > 1:
        raise InputError("the lines of a map need descriptors of one model, all of one length")

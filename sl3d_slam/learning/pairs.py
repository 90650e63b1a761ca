"""Pairs of scans to learn from, and which of their lines are the same."""

import numpy as np
from jaxtyping import Bool, Float, Float64, Int64

from sl3d_slam.geometry.se3 import Transform
from sl3d_slam.geometry.segments import angles_rad, directions, transform_segments

MAX_ANGLE_DEG = 10.0
SLACK_M = 0.5


def close_pairs(
    T_world_lidar: Float64[np.ndarray, "N 4 4"], max_distance_m: float
) -> Int64[np.ndarray, "P 2"]:
    """Return all pairs (i < j) of scans of a drive taken within a distance of each other."""
    places = T_world_lidar[:, :3, 3]
    gap = np.linalg.norm(places[:, None] - places[None], axis=2)
    first, second = np.nonzero(np.triu(gap <= max_distance_m, k=1))
    return np.stack([first, second], axis=1)


def gaps_of(
    T_world_lidar: Float64[np.ndarray, "N 4 4"], pairs: Int64[np.ndarray, "P 2"]
) -> Float64[np.ndarray, "P"]:
    """Return how far apart in metres the scans of each pair were taken."""
    steps = np.diff(T_world_lidar[pairs, :3, 3], axis=1)[:, 0]
    return np.asarray(np.linalg.norm(steps, axis=1))


def same_lines(
    target: Float[np.ndarray, "A 2 3"],
    source: Float[np.ndarray, "B 2 3"],
    T_target_source: Transform,
    max_distance_m: float,
) -> Int64[np.ndarray, "M 2"]:
    """Return rows (target, source) of lines that lie within a distance of each other.

    The distance is the mean of the source's end points from the target's line and the other way
    round (the paper's point-to-line distance); directions agree within 10 degrees, and along the
    line the two overlap. Each line is in at most one pair: the two are nearest to each other.
    """
    if len(target) == 0 or len(source) == 0:
        return np.zeros((0, 2), np.int64)
    moved = transform_segments(T_target_source, np.asarray(source, np.float64))
    target = np.asarray(target, np.float64)
    gap = 0.5 * (_gaps(target, moved) + _gaps(moved, target).T)
    along_target, along_source = directions(target), directions(moved)
    gap[angles_rad(along_target, along_source) > np.radians(MAX_ANGLE_DEG)] = np.inf
    gap[_apart(target, along_target, moved)] = np.inf
    best = gap.argmin(axis=1)
    rows = np.arange(len(target))
    mutual = (gap.argmin(axis=0)[best] == rows) & (gap[rows, best] <= max_distance_m)
    return np.stack([rows[mutual], best[mutual]], axis=1)


def _gaps(lines: np.ndarray, others: np.ndarray) -> Float64[np.ndarray, "A B"]:
    """Return the mean distance of the end points of ``others`` from each (infinite) line."""
    offset = others[None] - lines[:, None, :1]  # (A, B, 2, 3)
    along = directions(lines)[:, None, None]
    across = offset - (offset * along).sum(axis=-1, keepdims=True) * along
    return np.linalg.norm(across, axis=-1).mean(axis=-1)


def _apart(lines: np.ndarray, along: np.ndarray, others: np.ndarray) -> Bool[np.ndarray, "A B"]:
    """Tell which pairs do not overlap along the line."""
    length = np.linalg.norm(lines[:, 1] - lines[:, 0], axis=1)[:, None]
    t = ((others[None] - lines[:, None, :1]) * along[:, None, None]).sum(axis=-1)  # (A, B, 2)
    return (t.max(axis=-1) < -SLACK_M) | (t.min(axis=-1) > length + SLACK_M)


def draw_pair(
    pairs: Int64[np.ndarray, "P 2"],
    gaps_m: Float64[np.ndarray, "P"],
    wanted_m: float,
    rng: np.random.Generator,
) -> tuple[int, int]:
    """Draw one of the twentieth of the pairs whose distance is nearest to the wanted one.

    Distances wanted evenly are then met evenly, where most pairs of a drive lie far apart. Every
    pair can come up, in either order.
    """
    order = np.argsort(np.abs(gaps_m - wanted_m), kind="stable")
    first, second = pairs[int(rng.choice(order[: max(1, len(order) // 20)]))].tolist()
    return (first, second) if rng.random() < 0.5 else (second, first)

"""When two lines are the same one: within 0.3 m and 5 degrees of each other."""

import numpy as np
from jaxtyping import Float32, Float64, Int64

from sl3d_slam.geometry.segments import angles_rad, directions, lengths_m

AGREE_M, AGREE_DEG = 0.3, 5.0
MAX_GAP_M = 1.0
TOP = 5
TIE = 1e-6  # float32


def gaps_m(
    first: Float64[np.ndarray, "A 2 3"], second: Float64[np.ndarray, "B 2 3"]
) -> Float64[np.ndarray, "A B"]:
    """Return how far apart lines of one frame are; inf where they are not the same line at all.

    Both are compared in the middle of the stretch that they share along the first, or of the gap
    between them where that is at most 1 m long: two scans see different parts of one post. Lines
    more than 5 degrees apart, or further from each other along the line, get inf.
    """
    axes, lengths = directions(first), lengths_m(first)
    along = (
        np.einsum("bej,aj->abe", second, axes)
        - np.einsum("aj,aj->a", first[:, 0], axes)[:, None, None]
    )
    low = np.maximum(along.min(axis=2), 0.0)
    high = np.minimum(along.max(axis=2), lengths[:, None])
    middle = 0.5 * (low + high)
    spread = along[:, :, 1] - along[:, :, 0]
    share = (middle - along[:, :, 0]) / np.where(np.abs(spread) < 1e-9, np.inf, spread)
    on_first = first[:, None, 0] + middle[:, :, None] * axes[:, None]
    on_second = second[None, :, 0] + share[:, :, None] * (second[:, 1] - second[:, 0])[None]
    apart = np.linalg.norm(on_first - on_second, axis=2)
    angle = angles_rad(axes, directions(second))
    same = (angle <= np.radians(AGREE_DEG)) & (low - high <= MAX_GAP_M)
    return np.where(same, apart, np.inf)


def agreeing_pairs(gaps: Float64[np.ndarray, "A B"]) -> Int64[np.ndarray, "M 2"]:
    """Return pairs of lines that are nearest to each other both ways, and within 0.3 m."""
    if gaps.size == 0:
        return np.zeros((0, 2), np.int64)
    rows = np.arange(len(gaps))
    columns = gaps.argmin(axis=1)
    mutual = (gaps.argmin(axis=0)[columns] == rows) & (gaps[rows, columns] <= AGREE_M)
    return np.stack([rows[mutual], columns[mutual]], axis=1)


def partner_ranks(
    first: Float32[np.ndarray, "A D"],
    second: Float32[np.ndarray, "B D"],
    pairs: Int64[np.ndarray, "M 2"],
) -> Int64[np.ndarray, "M"]:
    """Return how many of ``second`` are as near in descriptor as the true partner, 1 at best.

    Ties count against the partner: a descriptor that says the same of all lines ranks it last.
    """
    similarity = first[pairs[:, 0]] @ second.T
    partner = np.take_along_axis(similarity, pairs[:, 1:], axis=1)
    return (similarity >= partner - TIE).sum(axis=1)

"""One landmark from many observations of a line: robust mean axis, extent, descriptor, kind."""

import numpy as np
from jaxtyping import Float64, Int64

from sl3d_slam.geometry.segments import directions, lengths_m, midpoints
from sl3d_slam.types import LineKind, LineSet

ROBUST_STEPS = 5
ROBUST_SCALE_M = 0.1
TRIMMED_SHARE = 0.1  # of the observations at either end, before the extent is read off


def mean_lines(
    lines: LineSet, weights: Float64[np.ndarray, "N"], groups: Int64[np.ndarray, "N"]
) -> LineSet:
    """Return one line for each group 0, 1, ...; every group has a member.

    The direction is the mean over members, long ones counting by their length squared (an end
    point errs alike on short and long lines); the axis passes through the robust mean (Cauchy
    weights, 0.1 m) of the members across that direction; it reaches from the first to the last
    tenth of the members' end points along it. Descriptors and scores are weighted means, the kind
    is the commonest, and ``num_points`` the mean.
    """
    count = int(groups.max()) + 1 if len(groups) else 0
    total = _sum(weights, groups, count)
    axis = _mean_directions(lines.endpoints, weights, groups, count)
    origin = _robust_origins(lines.endpoints, axis, weights, groups)
    along = np.einsum("nij,nj->ni", lines.endpoints - origin[groups][:, None], axis[groups])
    low = _quantile(along.min(axis=1), groups, count, TRIMMED_SHARE)
    high = _quantile(along.max(axis=1), groups, count, 1.0 - TRIMMED_SHARE)
    ends = np.stack([low, np.maximum(low, high)], axis=1)
    descriptors = _sum(lines.descriptors * weights[:, None], groups, count)
    norm = np.linalg.norm(descriptors, axis=1, keepdims=True)
    votes = _sum(weights, groups * len(LineKind) + lines.kinds, count * len(LineKind))
    return LineSet(
        endpoints=origin[:, None] + ends[:, :, None] * axis[:, None],
        descriptors=(descriptors / np.maximum(norm, 1e-12)).astype(np.float32),
        num_points=np.rint(_sum(weights * lines.num_points, groups, count) / total).astype(
            np.int64
        ),
        kinds=votes.reshape(count, len(LineKind)).argmax(axis=1).astype(np.uint8),
        scores=(_sum(weights * lines.scores, groups, count) / total).astype(np.float32),
    )


def _sum(values: np.ndarray, groups: Int64[np.ndarray, "N"], count: int) -> np.ndarray:
    """Add up the rows of each group, in row order."""
    if values.ndim == 1:
        return np.bincount(groups, weights=values, minlength=count)
    result = np.zeros((count, values.shape[1]))
    for column in range(values.shape[1]):
        result[:, column] = np.bincount(groups, weights=values[:, column], minlength=count)
    return result


def _mean_directions(
    endpoints: Float64[np.ndarray, "N 2 3"],
    weights: Float64[np.ndarray, "N"],
    groups: Int64[np.ndarray, "N"],
    count: int,
) -> Float64[np.ndarray, "L 3"]:
    """Return mean unit directions; members are turned to agree with their group's longest."""
    along, length = directions(endpoints), lengths_m(endpoints)
    order = np.lexsort((np.arange(len(groups)), -length, groups))
    longest = order[np.searchsorted(groups[order], np.arange(count))]
    sign = np.where(np.einsum("ij,ij->i", along, along[longest][groups]) < 0, -1.0, 1.0)
    mean = _sum(along * (sign * weights * length**2)[:, None], groups, count)
    norm = np.linalg.norm(mean, axis=1, keepdims=True)
    return np.where(norm > 1e-9, mean / np.maximum(norm, 1e-9), along[longest])


def _robust_origins(
    endpoints: Float64[np.ndarray, "N 2 3"],
    axis: Float64[np.ndarray, "L 3"],
    weights: Float64[np.ndarray, "N"],
    groups: Int64[np.ndarray, "N"],
) -> Float64[np.ndarray, "L 3"]:
    """Return a point of each landmark's axis: its members' middles, those far off counting less."""
    middle, count = midpoints(endpoints), len(axis)
    trust = weights
    for _ in range(ROBUST_STEPS):
        origin = _sum(middle * trust[:, None], groups, count) / _sum(trust, groups, count)[:, None]
        across = middle - origin[groups]
        across -= axis[groups] * np.einsum("ij,ij->i", across, axis[groups])[:, None]
        squared = np.einsum("ij,ij->i", across, across)
        trust = weights / (1.0 + squared / ROBUST_SCALE_M**2)
    return origin


def _quantile(
    values: Float64[np.ndarray, "N"], groups: Int64[np.ndarray, "N"], count: int, share: float
) -> Float64[np.ndarray, "L"]:
    """Return for each group the member's value at ``share`` of its sorted members."""
    order = np.lexsort((values, groups))
    starts = np.searchsorted(groups[order], np.arange(count + 1))
    members = np.diff(starts) - 1
    rank = np.floor(share * members) if share < 0.5 else np.ceil(share * members)
    return values[order[starts[:-1] + rank.astype(np.int64)]]

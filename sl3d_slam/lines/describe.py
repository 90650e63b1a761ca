"""A small hand-made descriptor: what the line is like and what stands around it.

Nothing in it depends on the heading; little depends on the viewpoint. It is the baseline that the
learned descriptor has to beat.
"""

import numpy as np
from jaxtyping import Float32, Float64

from sl3d_slam.geometry.se3 import Points

DIMENSION = 28
CONTEXT_CELL_M = 0.5
RING_EDGES_M = (1.0, 2.5, 5.0, 8.0, 12.0)
HEIGHT_EDGES_M = (0.25, 1.0, 2.0, 3.5, 12.0)
BOTTOM_CENTRES_M = (0.3, 1.0, 2.0)
TOP_CENTRES_M = (1.2, 2.0, 3.0, 4.5)
THICKNESS_CENTRES_M = (0.0, 0.12, 0.3)


def describe_uprights(
    places: Float64[np.ndarray, "L 2"],
    measures: Float64[np.ndarray, "L 4"],
    points: Points,
    heights: Float64[np.ndarray, "N"],
) -> Float32[np.ndarray, "L 28"]:
    """Return unit descriptors (L, 28).

    ``places`` are the lines seen from above; ``measures`` their bottom, top (metres above ground),
    thickness (metres) and whether they are edges (0 or 1); ``points`` the scan above the ground
    with its ``heights``. The entries: bottom (3) and top (4) and thickness (3) in soft bins, pole
    or edge (2), then 16 for the surroundings: the logarithm of the area occupied, in four rings
    out to 12 m by four layers of height.
    """
    own = np.concatenate(
        [
            _soft_bins(measures[:, 0], BOTTOM_CENTRES_M),
            _soft_bins(measures[:, 1], TOP_CENTRES_M),
            _soft_bins(measures[:, 2], THICKNESS_CENTRES_M),
            np.c_[1.0 - measures[:, 3], measures[:, 3]],
        ],
        axis=1,
    )
    context = _context(places, points, heights)
    context /= np.maximum(np.linalg.norm(context, axis=1, keepdims=True), 1e-9)
    joined = np.concatenate([0.5 * own, context], axis=1)
    return (joined / np.linalg.norm(joined, axis=1, keepdims=True)).astype(np.float32)


def _soft_bins(
    values: Float64[np.ndarray, "L"], centres: tuple[float, ...]
) -> Float64[np.ndarray, "L B"]:
    """Share each value between the two bin centres around it."""
    position = np.interp(values, centres, np.arange(len(centres)))
    return np.maximum(0.0, 1.0 - np.abs(position[:, None] - np.arange(len(centres))))


def _context(
    places: Float64[np.ndarray, "L 2"], points: Points, heights: Float64[np.ndarray, "N"]
) -> Float64[np.ndarray, "L 16"]:
    layer = np.digitize(heights, HEIGHT_EDGES_M) - 1
    kept = (layer >= 0) & (layer < 4)
    cells = np.floor(points[kept, :2] / CONTEXT_CELL_M).astype(np.int64)
    keys = np.unique((cells[:, 0] * 100_003 + cells[:, 1]) * 4 + layer[kept])
    flat, layers = keys // 4, keys % 4
    x = np.round(flat / 100_003).astype(np.int64)
    centres = (np.c_[x, flat - x * 100_003] + 0.5) * CONTEXT_CELL_M
    distance = np.linalg.norm(places[:, None] - centres[None], axis=2)
    ring = np.digitize(distance, RING_EDGES_M) - 1
    histogram = np.zeros((len(places), 16))
    for r in range(4):
        for a in range(4):
            histogram[:, 4 * r + a] = ((ring == r) & (layers == a)).sum(axis=1)
    return np.log1p(histogram)

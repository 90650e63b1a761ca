"""Which primitives touch which cells of a square grid."""

import numpy as np
from jaxtyping import Bool, Float64, Int64

from sl3d_slam.simulation.primitives import BOX, PATCH, Primitives, bounds

Layout = Float64[np.ndarray, "5"]
Indices = Int64[np.ndarray, "K"]


def cells_of(
    primitives: Primitives, layout: Layout, shape: tuple[int, int]
) -> tuple[Indices, Indices]:
    """Return (cell, primitive) pairs; ``layout`` starts with low x, low y, then 3 is the size.

    A long wall that stands askew is listed only where it passes, not all over its bounds.
    """
    boxes = bounds(primitives)
    limit = np.array([shape[1] - 1, shape[0] - 1])
    low = np.clip(((boxes[:, :2] - layout[:2]) / layout[3]).astype(int), 0, limit)
    high = np.clip(((boxes[:, 3:5] - layout[:2]) / layout[3]).astype(int), 0, limit)
    size = high - low + 1
    count = size[:, 0] * size[:, 1]
    items = np.repeat(np.arange(len(boxes)), count)
    rank = np.arange(len(items)) - np.repeat(np.cumsum(count) - count, count)
    i = low[items, 0] + rank % size[items, 0]
    j = low[items, 1] + rank // size[items, 0]
    centres = layout[:2] + layout[3] * (np.column_stack([i, j]) + 0.5)
    touches = _touches(primitives, items, centres, 0.5 * layout[3])
    return (j * shape[1] + i)[touches], items[touches]


def _touches(
    primitives: Primitives, items: Indices, centres: Float64[np.ndarray, "K 2"], half: float
) -> Bool[np.ndarray, "K"]:
    """Test walls along their normal and boxes along both of their sides (separating axes)."""
    p, kinds = primitives.parameters[items], primitives.kinds[items]
    away = centres - p[:, :2]
    result = np.ones(len(items), bool)
    wall = (kinds == PATCH) & (np.abs(p[:, 11]) < 1e-6)
    reach = half * (np.abs(p[:, 9]) + np.abs(p[:, 10])) + 0.01
    result[wall] = (np.abs(away[:, 0] * p[:, 9] + away[:, 1] * p[:, 10]) <= reach)[wall]
    box = kinds == BOX
    reach = half * (np.abs(p[:, 3]) + np.abs(p[:, 4])) + 0.01
    along = np.abs(away[:, 0] * p[:, 3] + away[:, 1] * p[:, 4]) <= reach + p[:, 5]
    across = np.abs(away[:, 1] * p[:, 3] - away[:, 0] * p[:, 4]) <= reach + p[:, 6]
    result[box] = (along & across)[box]
    return result

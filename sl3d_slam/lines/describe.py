"""A small hand-made descriptor: what the line is like and what stands around it.

Nothing in it depends on the heading; little depends on the viewpoint. It is the baseline that the
learned descriptor has to beat.
"""

from typing import no_type_check

import numpy as np
from jaxtyping import Float32, Float64
from numba import njit

from sl3d_slam.geometry.se3 import Points

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
    if len(cells) == 0:
        return np.zeros((len(places), 16))
    corner = cells.min(axis=0)
    occupied = np.zeros((*(cells.max(axis=0) - corner + 1), 4), np.bool_)
    occupied[cells[:, 0] - corner[0], cells[:, 1] - corner[1], layer[kept]] = True
    return np.log1p(_occupied_rings(places, occupied, corner))


@njit(cache=True, nogil=True)
@no_type_check
def _occupied_rings(places: np.ndarray, occupied: np.ndarray, corner: np.ndarray) -> np.ndarray:
    """Count the occupied cells around places (L, 2) by ring and layer (L, 16)."""
    histogram = np.zeros((len(places), 16))
    reach = int(np.ceil(RING_EDGES_M[-1] / CONTEXT_CELL_M)) + 1
    for i in range(len(places)):
        cx = int(np.floor(places[i, 0] / CONTEXT_CELL_M)) - corner[0]
        cy = int(np.floor(places[i, 1] / CONTEXT_CELL_M)) - corner[1]
        for x in range(max(cx - reach, 0), min(cx + reach + 1, occupied.shape[0])):
            for y in range(max(cy - reach, 0), min(cy + reach + 1, occupied.shape[1])):
                dx = places[i, 0] - (x + corner[0] + 0.5) * CONTEXT_CELL_M
                dy = places[i, 1] - (y + corner[1] + 0.5) * CONTEXT_CELL_M
                ring = _ring(np.sqrt(dx * dx + dy * dy))
                if 0 <= ring < 4:
                    for layer in range(4):
                        histogram[i, 4 * ring + layer] += occupied[x, y, layer]
    return histogram


@njit(cache=True)
@no_type_check
def _ring(distance: float) -> int:
    ring = -1
    for edge in RING_EDGES_M:
        ring += distance >= edge
    return ring

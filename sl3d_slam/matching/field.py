"""A bird's-eye distance field: how well a planar pose lays one scan's structure on another's.

Evenly spaced lamps fool lines alone. What stands between them does not: a source cell that falls on
target structure speaks for a pose, one that falls on street which the target saw to be empty speaks
against it, and one that falls where the target saw nothing says nothing.
"""

from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Float32, Float64
from numba import njit
from scipy import ndimage

from sl3d_slam.geometry.se3 import Points

CELL_M = 0.5
HALF_WIDTH_M = 80.0
SIZE = int(2 * HALF_WIDTH_M / CELL_M)
STRUCTURE_M = (0.5, 8.0)
GROUND_M = 0.3
NEAR_M = 0.8
EMPTY_COST = 0.6
MAX_POINTS = 600
MIN_KNOWN_SHARE = 0.35


@dataclass(frozen=True, slots=True, eq=False)
class StructureField:
    """One view from above, in its levelled frame.

    Attributes
    ----------
    value : (SIZE, SIZE) in [-1, 1]: near 1 on structure, negative on empty street, 0 unknown.
    points : (P, 2) metres, the centres of structure cells, at most 600.
    """

    value: Float32[np.ndarray, "X Y"]
    points: Float64[np.ndarray, "P 2"]


def build_field(points_level: Points, heights: Float32[np.ndarray, "N"]) -> StructureField:
    """Draw a coarse cloud, given in its levelled frame with heights above ground, from above."""
    cells = np.floor((points_level[:, :2] + HALF_WIDTH_M) / CELL_M).astype(np.int64)
    inside = np.all((cells >= 0) & (cells < SIZE), axis=1)
    cells, heights = cells[inside], heights[inside]
    structure = _mask(cells[(heights > STRUCTURE_M[0]) & (heights < STRUCTURE_M[1])])
    street = ndimage.binary_dilation(_mask(cells[np.abs(heights) < GROUND_M]), iterations=1)
    gap_m = CELL_M * ndimage.distance_transform_edt(~structure)
    value = np.exp(-((gap_m / NEAR_M) ** 2))
    value[street & (gap_m > 1.5 * NEAR_M)] = -EMPTY_COST
    occupied = np.argwhere(structure)
    stride = max(1, -(-len(occupied) // MAX_POINTS))
    points = (occupied[::stride] + 0.5) * CELL_M - HALF_WIDTH_M
    return StructureField(value.astype(np.float32), points)


def score_poses(
    source: StructureField, target: StructureField, poses: Float64[np.ndarray, "H 3"]
) -> Float64[np.ndarray, "H"]:
    """Return in [-0.6, 1] how well each planar pose (yaw, x, y) lays source cells on the target."""
    return _mean_values(source.points, target.value, poses)


def invert_poses(poses: Float64[np.ndarray, "H 3"]) -> Float64[np.ndarray, "H 3"]:
    """Return the planar poses of the target in the source frame."""
    c, s = np.cos(poses[:, 0]), np.sin(poses[:, 0])
    x = -(c * poses[:, 1] + s * poses[:, 2])
    y = s * poses[:, 1] - c * poses[:, 2]
    return np.stack([-poses[:, 0], x, y], axis=1)


def _mask(cells: np.ndarray) -> np.ndarray:
    grid = np.zeros((SIZE, SIZE), bool)
    grid[cells[:, 0], cells[:, 1]] = True
    return grid


@njit(cache=True)
@no_type_check
def _mean_values(points: np.ndarray, value: np.ndarray, poses: np.ndarray) -> np.ndarray:
    scores = np.zeros(len(poses))
    for h in range(len(poses)):
        c, s = np.cos(poses[h, 0]), np.sin(poses[h, 0])
        total, known = 0.0, 0
        for i in range(len(points)):
            x = c * points[i, 0] - s * points[i, 1] + poses[h, 1]
            y = s * points[i, 0] + c * points[i, 1] + poses[h, 2]
            u, v = (x + HALF_WIDTH_M) / CELL_M, (y + HALF_WIDTH_M) / CELL_M
            if u < 0.0 or v < 0.0 or u >= SIZE or v >= SIZE:
                continue
            cell = value[int(u), int(v)]
            if cell > 0.05 or cell < 0.0:
                known += 1
                total += cell
        scores[h] = total / max(known, MIN_KNOWN_SHARE * len(points), 1.0)
    return scores

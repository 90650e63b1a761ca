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

from sl3d_slam.geometry.se3 import Points

CELL_M = 0.5
HALF_WIDTH_M = 80.0
SIZE = int(2 * HALF_WIDTH_M / CELL_M)
STRUCTURE_M = (0.5, 8.0)
GROUND_M = 0.3
NEAR_M = 0.8
FAR_M = 1.3  # from structure, where a cell says nothing, or speaks against a pose on empty street
EMPTY_COST = 0.6
MAX_POINTS = 600
MIN_KNOWN_SHARE = 0.35


@dataclass(frozen=True, slots=True, eq=False)
class StructureField:
    """One view from above, in its levelled frame.

    Attributes
    ----------
    value : (SIZE, SIZE) in [-1, 1]: 1 on structure, less beside it, negative on empty street, 0
        unknown.
    points : (P, 2) metres, the centres of structure cells, at most 600.
    """

    value: Float32[np.ndarray, "X Y"]
    points: Float64[np.ndarray, "P 2"]


def build_field(points_level: Points, heights: Float32[np.ndarray, "N"]) -> StructureField:
    """Draw a coarse cloud, given in its levelled frame with heights above ground, from above."""
    value = np.zeros((SIZE, SIZE), np.float32)
    occupied = np.zeros((SIZE, SIZE), np.bool_)
    _draw(points_level, heights, occupied, value)
    rows = np.argwhere(occupied)
    stride = max(1, -(-len(rows) // MAX_POINTS))
    return StructureField(value, (rows[::stride] + 0.5) * CELL_M - HALF_WIDTH_M)


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


@njit(cache=True, nogil=True)
@no_type_check
def _draw(points: np.ndarray, heights: np.ndarray, occupied: np.ndarray, value: np.ndarray) -> None:
    """Mark empty street, a cell more to each side, then structure and how near it is."""
    for i in range(len(points)):
        if abs(heights[i]) < GROUND_M:
            x = int(np.floor((points[i, 0] + HALF_WIDTH_M) / CELL_M))
            y = int(np.floor((points[i, 1] + HALF_WIDTH_M) / CELL_M))
            if 0 <= x < SIZE and 0 <= y < SIZE:
                value[max(x - 1, 0) : x + 2, y] = -EMPTY_COST
                value[x, max(y - 1, 0) : y + 2] = -EMPTY_COST
    for i in range(len(points)):
        if STRUCTURE_M[0] < heights[i] < STRUCTURE_M[1]:
            x = int(np.floor((points[i, 0] + HALF_WIDTH_M) / CELL_M))
            y = int(np.floor((points[i, 1] + HALF_WIDTH_M) / CELL_M))
            if 0 <= x < SIZE and 0 <= y < SIZE and not occupied[x, y]:
                occupied[x, y] = True
                _raise_around(x, y, value)


@njit(cache=True, nogil=True)
@no_type_check
def _raise_around(x: int, y: int, value: np.ndarray) -> None:
    """Write how near the cells around a cell of structure are; beyond them it counts as far."""
    for u in range(max(x - 2, 0), min(x + 3, SIZE)):
        for v in range(max(y - 2, 0), min(y + 3, SIZE)):
            gap_m = CELL_M * np.sqrt((u - x) ** 2 + (v - y) ** 2)
            if gap_m < FAR_M:
                value[u, v] = max(value[u, v], np.exp(-((gap_m / NEAR_M) ** 2)))


@njit(cache=True, nogil=True)
@no_type_check
def _mean_values(points: np.ndarray, value: np.ndarray, poses: np.ndarray) -> np.ndarray:
    scores = np.zeros(len(poses))
    cells, middle = points / CELL_M, HALF_WIDTH_M / CELL_M
    for h in range(len(poses)):
        c, s = np.cos(poses[h, 0]), np.sin(poses[h, 0])
        at_u, at_v = poses[h, 1] / CELL_M + middle, poses[h, 2] / CELL_M + middle
        total, known = 0.0, 0
        for i in range(len(cells)):
            u = c * cells[i, 0] - s * cells[i, 1] + at_u
            v = s * cells[i, 0] + c * cells[i, 1] + at_v
            if 0.0 <= u < SIZE and 0.0 <= v < SIZE:
                near = value[int(u), int(v)]
                known += near != 0.0
                total += near
        scores[h] = total / max(known, MIN_KNOWN_SHARE * len(cells), 1.0)
    return scores

"""The cells and squares of the network's wide view: which there are, which lie near each other."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float32, Float64, Int64
from scipy.spatial import cKDTree

from sl3d_slam.lines.network.neighbours import skip_neighbours
from sl3d_slam.lines.network.shapes import EXCHANGES

CELL_M = 2.0
SQUARE_M = 8.0
NUM_NEIGHBOURS = 20
STRIDES = (1, 3)
MAX_GAP_M = 40.0
SEARCH_M = 8.0

assert len(STRIDES) == EXCHANGES


@dataclass(frozen=True, slots=True, eq=False)
class Cells:
    """The occupied cells of one or several clouds, and the squares seen from above that hold them.

    Attributes
    ----------
    cell_of : (M,) the cell of each point.
    neighbours : for each exchange (K, k), nearest cells of the same cloud, itself first; a cloud
        of few cells names itself more than once.
    gaps : for each exchange (K, k, 2), their horizontal and vertical distance in tens of metres;
        the heading does not count.
    square_of : (K,) the square of each cell.
    squares : (K, k) the squares of the same cloud nearest to each cell, some more than once where
        there are too few.
    square_gaps : (K, k, 2) as ``gaps``.
    """

    cell_of: Int64[np.ndarray, "M"]
    neighbours: tuple[Int64[np.ndarray, "K _"], ...]
    gaps: tuple[Float32[np.ndarray, "K _ 2"], ...]
    square_of: Int64[np.ndarray, "K"]
    squares: Int64[np.ndarray, "K k"]
    square_gaps: Float32[np.ndarray, "K k 2"]

    @property
    def num_squares(self) -> int:
        """How many squares there are."""
        return int(self.square_of.max()) + 1


def find_cells(points: Float32[np.ndarray, "M 3"], cloud_of: Int64[np.ndarray, "M"]) -> Cells:
    """Sort x, y, z into cells, anchored at each cloud's mean: moving a cloud changes nothing.

    ``cloud_of`` says which cloud each point is of: 0, then 1, and so on.
    """
    bounds = np.searchsorted(cloud_of, np.arange(cloud_of[-1] + 2))
    clouds = [_find_own(points[first:stop]) for first, stop in pairwise(bounds)]
    cells_before = np.cumsum([0, *(len(cloud.square_of) for cloud in clouds)])
    squares_before = np.cumsum([0, *(cloud.num_squares for cloud in clouds)])
    first_cell, first_square = (before[:-1].tolist() for before in (cells_before, squares_before))
    return Cells(
        _joined([cloud.cell_of for cloud in clouds], first_cell),
        tuple(_joined([c.neighbours[e] for c in clouds], first_cell) for e in range(EXCHANGES)),
        tuple(np.concatenate([c.gaps[e] for c in clouds]) for e in range(EXCHANGES)),
        _joined([cloud.square_of for cloud in clouds], first_square),
        _joined([cloud.squares for cloud in clouds], first_square),
        np.concatenate([cloud.square_gaps for cloud in clouds]),
    )


def _joined(indices: list[np.ndarray], before: list[int]) -> np.ndarray:
    return np.concatenate([rows + count for rows, count in zip(indices, before, strict=True)])


def _find_own(points: Float32[np.ndarray, "M 3"]) -> Cells:
    """Return the cells of one cloud."""
    cell_of, centres = _means_of_boxes(points, CELL_M)
    near = _nearest(centres)
    chosen = [np.ascontiguousarray(near[:, : s * NUM_NEIGHBOURS : s]) for s in STRIDES]
    gaps = [_gaps(centres, centres, neighbours) for neighbours in chosen]
    flat = centres * [1.0, 1.0, 0.0]
    square_of = _means_of_boxes(flat, SQUARE_M)[0]
    count = np.bincount(square_of)
    middles = np.stack([np.bincount(square_of, axis) / count for axis in centres.T], axis=1)
    squares = _nearest_squares(flat, middles * [1.0, 1.0, 0.0])
    square_gaps = _gaps(centres, middles, squares)
    return Cells(cell_of, tuple(chosen), tuple(gaps), square_of, squares, square_gaps)


def _means_of_boxes(points: np.ndarray, side_m: float) -> tuple[Int64[np.ndarray, "M"], np.ndarray]:
    """Return the box of each point of a cloud, and the means of their points (K, 3)."""
    steps = np.floor((points - points.mean(axis=0, dtype=np.float64)) / side_m).astype(np.int64)
    steps += 100_000
    keys = (steps[:, 0] * 200_000 + steps[:, 1]) * 200_000 + steps[:, 2]
    order = np.argsort(keys, kind="stable")
    ordered = keys[order]
    cell_of = np.empty(len(keys), np.int64)
    cell_of[order] = np.cumsum(np.r_[False, ordered[1:] != ordered[:-1]])
    count = np.bincount(cell_of)
    centres = [np.bincount(cell_of, points[:, axis]) / count for axis in range(3)]
    return cell_of, np.stack(centres, axis=1)


def _nearest(centres: np.ndarray) -> Int64[np.ndarray, "K R"]:
    """Return the nearest cells of each cell, itself first and again where there are too few."""
    reach = NUM_NEIGHBOURS * max(STRIDES)
    nearest = np.repeat(np.arange(len(centres))[:, None], reach, axis=1)
    found = min(reach, len(centres))
    nearest[:, :found] = skip_neighbours(centres, found, 1, SEARCH_M)
    return nearest


def _nearest_squares(
    cells: Float64[np.ndarray, "K 3"], squares: Float64[np.ndarray, "S 3"]
) -> Int64[np.ndarray, "K k"]:
    """Return the nearest squares of each cell, the last one again where there are too few."""
    found = min(NUM_NEIGHBOURS, len(squares))
    nearest = cKDTree(squares).query(cells, k=np.arange(1, found + 1))[1]
    return np.pad(nearest, ((0, 0), (0, NUM_NEIGHBOURS - found)), mode="edge")


def _gaps(
    places: np.ndarray, others: np.ndarray, neighbours: Int64[np.ndarray, "K k"]
) -> Float32[np.ndarray, "K k 2"]:
    offset = others[neighbours] - places[:, None]
    horizontal = np.minimum(np.hypot(offset[..., 0], offset[..., 1]), MAX_GAP_M)
    vertical = np.clip(offset[..., 2], -MAX_GAP_M, MAX_GAP_M)
    return (np.stack([horizontal, vertical], axis=-1) / 10.0).astype(np.float32)

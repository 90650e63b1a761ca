"""The cells of the network's wide view: which there are and which lie near each other."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float32, Int64

from sl3d_slam.lines.network.neighbours import skip_neighbours
from sl3d_slam.lines.network.shapes import EXCHANGES

CELL_M = 2.0
NUM_NEIGHBOURS = 20
STRIDES = (1, 3)
MAX_GAP_M = 20.0
SEARCH_M = 8.0

assert len(STRIDES) == EXCHANGES


@dataclass(frozen=True, slots=True, eq=False)
class Cells:
    """The occupied cells of one or several clouds.

    Attributes
    ----------
    cell_of : (M,) the cell of each point.
    neighbours : for each exchange (K, k), nearest cells of the same cloud, itself first; a cloud
        of few cells names itself more than once.
    gaps : for each exchange (K, k, 2), their horizontal and vertical distance in tens of metres;
        the heading does not count.
    """

    cell_of: Int64[np.ndarray, "M"]
    neighbours: tuple[Int64[np.ndarray, "K _"], ...]
    gaps: tuple[Float32[np.ndarray, "K _ 2"], ...]


def find_cells(points: Float32[np.ndarray, "M 3"], cloud_of: Int64[np.ndarray, "M"]) -> Cells:
    """Sort x, y, z into cells, anchored at each cloud's mean: moving a cloud changes nothing.

    ``cloud_of`` says which cloud each point is of: 0, then 1, and so on.
    """
    bounds = np.searchsorted(cloud_of, np.arange(cloud_of[-1] + 2))
    cell_of, centres, nearest, before = [], [], [], 0
    for first, stop in pairwise(bounds):
        own, middles = _sorted_into_cells(points[first:stop])
        cell_of.append(own + before)
        nearest.append(_nearest(middles) + before)
        centres.append(middles)
        before += len(middles)
    places, near = np.concatenate(centres), np.concatenate(nearest)
    chosen = [np.ascontiguousarray(near[:, : s * NUM_NEIGHBOURS : s]) for s in STRIDES]
    gaps = [_gaps(places, neighbours) for neighbours in chosen]
    return Cells(np.concatenate(cell_of), tuple(chosen), tuple(gaps))


def _sorted_into_cells(
    points: Float32[np.ndarray, "M 3"],
) -> tuple[Int64[np.ndarray, "M"], np.ndarray]:
    """Return the cell of each point of a cloud, and the cells' centres (K, 3)."""
    steps = np.floor((points - points.mean(axis=0, dtype=np.float64)) / CELL_M).astype(np.int64)
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


def _gaps(
    centres: np.ndarray, neighbours: Int64[np.ndarray, "K k"]
) -> Float32[np.ndarray, "K k 2"]:
    offset = centres[neighbours] - centres[:, None]
    horizontal = np.minimum(np.hypot(offset[..., 0], offset[..., 1]), MAX_GAP_M)
    vertical = np.clip(offset[..., 2], -MAX_GAP_M, MAX_GAP_M)
    return (np.stack([horizontal, vertical], axis=-1) / 10.0).astype(np.float32)

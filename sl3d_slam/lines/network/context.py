"""A wide view: features pooled into cells of 2 m, exchanged between cells, given back to points."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float32, Int64
from scipy.spatial import cKDTree
from torch import Tensor, nn

CELL_M = 2.0
NUM_NEIGHBOURS = 20
STRIDES = (1, 3)
MAX_GAP_M = 20.0


@dataclass(frozen=True, slots=True, eq=False)
class Cells:
    """The occupied cells of one or several clouds.

    Attributes
    ----------
    cell_of : (M,) the cell of each point.
    neighbours : for each exchange (K, k), nearest cells of the same cloud, itself first.
    gaps : for each exchange (K, k, 2), their horizontal and vertical distance in tens of metres;
        the heading does not count.
    """

    cell_of: Int64[Tensor, "M"]
    neighbours: tuple[Int64[Tensor, "K _"], ...]
    gaps: tuple[Float32[Tensor, "K _ 2"], ...]

    def to(self, device: torch.device) -> "Cells":
        """Return the same cells on a device."""
        return Cells(
            self.cell_of.to(device),
            tuple(neighbours.to(device) for neighbours in self.neighbours),
            tuple(gaps.to(device) for gaps in self.gaps),
        )


def find_cells(points: Float32[np.ndarray, "M 3"], cloud_of: Int64[np.ndarray, "M"]) -> Cells:
    """Sort x, y, z into cells, anchored at each cloud's mean: moving a cloud changes nothing."""
    corner = np.zeros((cloud_of.max() + 1, 3))
    for cloud in range(len(corner)):
        corner[cloud] = points[cloud_of == cloud].mean(axis=0, dtype=np.float64)
    steps = np.floor((points - corner[cloud_of]) / CELL_M).astype(np.int64) + 100_000
    keys = ((cloud_of * 200_000 + steps[:, 0]) * 200_000 + steps[:, 1]) * 200_000 + steps[:, 2]
    _, first, cell_of = np.unique(keys, return_index=True, return_inverse=True)
    count = np.bincount(cell_of)
    centres = np.stack([np.bincount(cell_of, points[:, a]) / count for a in range(3)], axis=1)
    # clouds lie apart here, so that a cell's nearest cells are of its own cloud
    apart = np.c_[centres, 1e5 * cloud_of[first]]
    nearest = cKDTree(apart).query(apart, min(NUM_NEIGHBOURS * max(STRIDES), len(apart)))[1]
    nearest = nearest.reshape(len(apart), -1)
    same = cloud_of[first][nearest] == cloud_of[first][:, None]
    nearest = np.where(same, nearest, np.arange(len(apart))[:, None])
    chosen = [nearest[:, : stride * NUM_NEIGHBOURS : stride] for stride in STRIDES]
    gaps = [_gaps(centres, neighbours) for neighbours in chosen]
    return Cells(
        torch.from_numpy(cell_of.astype(np.int64)),
        tuple(torch.from_numpy(np.ascontiguousarray(n, np.int64)) for n in chosen),
        tuple(torch.from_numpy(gap) for gap in gaps),
    )


def _gaps(
    centres: np.ndarray, neighbours: Int64[np.ndarray, "K k"]
) -> Float32[np.ndarray, "K k 2"]:
    offset = centres[neighbours] - centres[:, None]
    horizontal = np.minimum(np.hypot(offset[..., 0], offset[..., 1]), MAX_GAP_M)
    vertical = np.clip(offset[..., 2], -MAX_GAP_M, MAX_GAP_M)
    return (np.stack([horizontal, vertical], axis=-1) / 10.0).astype(np.float32)


class Context(nn.Module):
    """Pool point features into cells and let each cell see its neighbours, twice, ever wider."""

    def __init__(self, channels_in: int, width: int) -> None:
        super().__init__()
        self.lift = nn.Linear(channels_in, width)
        self.exchanges = nn.ModuleList(CellConv(width) for _ in STRIDES)

    def forward(self, features: Float32[Tensor, "M C"], cells: Cells) -> Float32[Tensor, "M D"]:
        """Return for each point what its cell has learned of the surroundings."""
        lifted = nn.functional.relu(self.lift(features))
        rows = cells.cell_of[:, None].expand_as(lifted)
        pooled = lifted.new_zeros(len(cells.gaps[0]), lifted.shape[1])
        pooled = pooled.scatter_reduce(0, rows, lifted, "amax")  # features are never negative
        for exchange, neighbours, gaps in zip(
            self.exchanges, cells.neighbours, cells.gaps, strict=True
        ):
            pooled = pooled + exchange(pooled, neighbours, gaps)
        return pooled[cells.cell_of]


class CellConv(nn.Module):
    """EdgeConv over cells whose edges also know how far apart the two cells are."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.centre = nn.Linear(width, width)
        self.edge = nn.Linear(width, width, bias=False)
        self.gap = nn.Linear(2, width, bias=False)
        self.mix = nn.Linear(width, width)
        self.norm = nn.LayerNorm(width)

    def forward(
        self,
        features: Float32[Tensor, "K C"],
        neighbours: Int64[Tensor, "K k"],
        gaps: Float32[Tensor, "K k 2"],
    ) -> Float32[Tensor, "K C"]:
        """Return what the neighbouring cells tell each cell."""
        heard = self.edge(features)[neighbours] + self.gap(gaps)  # (K, k, C)
        edges = nn.functional.relu(heard + self.centre(features)[:, None])
        return nn.functional.relu(self.norm(self.mix(edges.amax(dim=1))))

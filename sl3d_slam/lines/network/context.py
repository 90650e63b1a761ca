"""A wide view: features pooled into cells of 2 m, exchanged between cells, given back to points.

Cells hear of their neighbours twice, ever wider, and at last of squares of 8 m, some 20 m around.
"""

import torch
from jaxtyping import Float32, Int64
from torch import Tensor, nn

from sl3d_slam.lines.network.cells import Cells
from sl3d_slam.lines.network.shapes import EXCHANGES


class Context(nn.Module):
    """Pool point features into cells and let each cell hear of its surroundings."""

    def __init__(self, channels_in: int, width: int) -> None:
        super().__init__()
        self.lift = nn.Linear(channels_in, width)
        self.exchanges = nn.ModuleList(CellConv(width) for _ in range(EXCHANGES))
        self.outlook = CellConv(width)

    def forward(self, features: Float32[Tensor, "M C"], cells: Cells) -> Float32[Tensor, "M D"]:
        """Return for each point what its cell has learned of the surroundings."""
        lifted = nn.functional.relu(self.lift(features))
        device = features.device
        cell_of = torch.from_numpy(cells.cell_of).to(device)
        pooled = _pooled(lifted, cell_of)
        for exchange, neighbours, gaps in zip(
            self.exchanges, cells.neighbours, cells.gaps, strict=True
        ):
            near, apart = torch.from_numpy(neighbours), torch.from_numpy(gaps)
            pooled = pooled + exchange(pooled, pooled, near.to(device), apart.to(device))
        squares = _pooled(pooled, torch.from_numpy(cells.square_of).to(device))
        near, apart = torch.from_numpy(cells.squares), torch.from_numpy(cells.square_gaps)
        pooled = pooled + self.outlook(pooled, squares, near.to(device), apart.to(device))
        return pooled[cell_of]


def _pooled(rows: Float32[Tensor, "M C"], group_of: Int64[Tensor, "M"]) -> Float32[Tensor, "K C"]:
    """Return the largest of each group's rows, which are never negative."""
    pooled = rows.new_zeros(int(group_of.max()) + 1, rows.shape[1])
    return pooled.scatter_reduce(0, group_of[:, None].expand_as(rows), rows, "amax")


class CellConv(nn.Module):
    """EdgeConv over cells whose edges also know how far apart the two ends are."""

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
        tellers: Float32[Tensor, "T C"],
        neighbours: Int64[Tensor, "K k"],
        gaps: Float32[Tensor, "K k 2"],
    ) -> Float32[Tensor, "K C"]:
        """Return what each cell hears of the tellers that are its neighbours."""
        heard = self.edge(tellers)[neighbours] + self.gap(gaps)  # (K, k, C)
        edges = nn.functional.relu(heard + self.centre(features)[:, None])
        return nn.functional.relu(self.norm(self.mix(edges.amax(dim=1))))

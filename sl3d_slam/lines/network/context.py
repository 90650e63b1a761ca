"""A wide view: features pooled into cells of 2 m, exchanged between cells, given back to points."""

import torch
from jaxtyping import Float32, Int64
from torch import Tensor, nn

from sl3d_slam.lines.network.cells import Cells
from sl3d_slam.lines.network.shapes import EXCHANGES


class Context(nn.Module):
    """Pool point features into cells and let each cell see its neighbours, twice, ever wider."""

    def __init__(self, channels_in: int, width: int) -> None:
        super().__init__()
        self.lift = nn.Linear(channels_in, width)
        self.exchanges = nn.ModuleList(CellConv(width) for _ in range(EXCHANGES))

    def forward(self, features: Float32[Tensor, "M C"], cells: Cells) -> Float32[Tensor, "M D"]:
        """Return for each point what its cell has learned of the surroundings."""
        lifted = nn.functional.relu(self.lift(features))
        device = features.device
        cell_of = torch.from_numpy(cells.cell_of).to(device)
        rows = cell_of[:, None].expand_as(lifted)
        pooled = lifted.new_zeros(len(cells.gaps[0]), lifted.shape[1])
        pooled = pooled.scatter_reduce(0, rows, lifted, "amax")  # features are never negative
        for exchange, neighbours, gaps in zip(
            self.exchanges, cells.neighbours, cells.gaps, strict=True
        ):
            near, apart = torch.from_numpy(neighbours), torch.from_numpy(gaps)
            pooled = pooled + exchange(pooled, near.to(device), apart.to(device))
        return pooled[cell_of]


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

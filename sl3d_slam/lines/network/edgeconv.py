"""EdgeConv, in the form it is defined in and in a cheaper one that gives the same numbers."""

import torch
from jaxtyping import Float32, Int64
from torch import Tensor, nn

from sl3d_slam.lines.network.edge_max import edge_max
from sl3d_slam.lines.network.gather import gather_max
from sl3d_slam.lines.network.shapes import HIDDEN

PIECE = 128


class EdgeConv(nn.Module):
    """``relu(norm(max_j W1 x_i + W2 (x_j - x_i)))`` over the neighbours j of each point i.

    The norm and the activation follow the maximum, so that the maximum meets a linear form alone:
    ``max_j W1 x_i + W2 (x_j - x_i) = (W1 - W2) x_i + max_j W2 x_j``. One product a point instead of
    one an edge, and exact (Wang et al., Dynamic Graph CNN, TOG 2019, for the layer).
    """

    def __init__(self, channels_in: int, channels_out: int) -> None:
        super().__init__()
        self.centre = nn.Linear(channels_in, channels_out)
        self.edge = nn.Linear(channels_in, channels_out, bias=False)
        self.norm = nn.LayerNorm(channels_out)

    def forward(
        self, features: Float32[Tensor, "M C"], neighbours: Int64[Tensor, "M k"]
    ) -> Float32[Tensor, "M D"]:
        """Return the features of the next block, in the cheap form."""
        own = nn.functional.linear(
            features, self.centre.weight - self.edge.weight, self.centre.bias
        )
        largest = gather_max(self.edge(features), neighbours)
        return nn.functional.relu(self.norm(own + largest))

    def literal(
        self, features: Float32[Tensor, "M C"], neighbours: Int64[Tensor, "M k"]
    ) -> Float32[Tensor, "M D"]:
        """Return the same as :meth:`forward`, edge by edge, as the layer is defined."""
        difference = features[neighbours] - features[:, None]  # (M, k, C)
        edges = self.centre(features)[:, None] + self.edge(difference)  # (M, k, D)
        return nn.functional.relu(self.norm(edges.amax(dim=1)))


class OffsetConv(nn.Module):
    """The first block: a small network on each neighbour's offset, then the maximum.

    It never sees a position, only offsets, so moving the whole cloud changes nothing.
    """

    def __init__(self, channels_in: int, channels_out: int) -> None:
        super().__init__()
        self.first = nn.Linear(channels_in, HIDDEN)
        self.second = nn.Linear(HIDDEN, channels_out)
        self.norm = nn.LayerNorm(channels_out)

    def forward(self, offsets: Float32[Tensor, "M k C"]) -> Float32[Tensor, "M D"]:
        """Return features of points from the offsets of their neighbours."""
        if torch.is_grad_enabled() and offsets.dtype == torch.float32 and not offsets.is_cuda:
            pre = self.first(offsets.flatten(0, 1))
            largest = edge_max(pre, self.second.weight, offsets.shape[1]) + self.second.bias
        elif torch.is_grad_enabled():
            largest = self._largest(offsets)
        else:  # pieces that stay in the processor's cache
            largest = torch.cat([self._largest(piece) for piece in torch.split(offsets, PIECE)])
        return nn.functional.relu(self.norm(largest))

    def _largest(self, offsets: Float32[Tensor, "M k C"]) -> Float32[Tensor, "M D"]:
        edges: Tensor = self.second(nn.functional.relu(self.first(offsets)))  # (M, k, D)
        return edges.amax(dim=1)

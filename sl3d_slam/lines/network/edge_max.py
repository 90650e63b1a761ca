"""The largest of a point's edges after a hidden layer, with a gradient as sparse as a maximum's."""

from typing import Any, no_type_check

import numpy as np
import torch
from jaxtyping import Float32
from numba import njit
from torch import Tensor

PIECE = 512


def edge_max(
    pre: Float32[Tensor, "E H"], weight: Float32[Tensor, "D H"], k: int
) -> Float32[Tensor, "M D"]:
    """Return ``max_j W relu(pre_ij)`` per channel over the k edges j of each point i.

    ``pre`` holds the edges point by point, E = M k. On the CPU only: of the k edges one a channel
    has a gradient, so going back costs a k-th of the two dense products (measured: a fifth off a
    whole training step).
    """
    return _EdgeMax.apply(pre, weight, k)  # type: ignore[no-untyped-call]


class _EdgeMax(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, pre: Tensor, weight: Tensor, k: int) -> Tensor:
        hidden = pre.clamp(min=0.0)
        count, channels = len(pre) // k, len(weight)
        largest = torch.empty(count, channels)
        winner = torch.empty(count, channels, dtype=torch.uint8)
        for begin in range(0, count, PIECE):  # pieces that stay in the processor's cache
            rows = slice(begin, min(begin + PIECE, count))
            edges = hidden[rows.start * k : rows.stop * k] @ weight.t()
            _find_largest(edges.numpy(), largest.numpy()[rows], winner.numpy()[rows], k)
        ctx.save_for_backward(hidden, weight, winner)
        ctx.k = k
        return largest

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor, None]:
        hidden, weight, winner = ctx.saved_tensors
        to_hidden, to_weight = torch.zeros_like(hidden), torch.zeros_like(weight)
        _spread(
            (gradient.contiguous().numpy(), winner.numpy()),
            (hidden.numpy(), weight.contiguous().numpy()),
            (to_hidden.numpy(), to_weight.numpy()),
            ctx.k,
        )
        return to_hidden, to_weight, None


@njit(cache=True, nogil=True)
@no_type_check
def _find_largest(edges: np.ndarray, largest: np.ndarray, winner: np.ndarray, k: int) -> None:
    for i in range(len(largest)):
        for c in range(largest.shape[1]):
            largest[i, c] = edges[i * k, c]
            winner[i, c] = 0
        for j in range(1, k):
            row = i * k + j
            for c in range(largest.shape[1]):
                better = edges[row, c] > largest[i, c]
                largest[i, c] = edges[row, c] if better else largest[i, c]
                winner[i, c] = np.uint8(j) if better else winner[i, c]


@njit(cache=True, nogil=True, fastmath=True)
@no_type_check
def _spread(
    found: tuple[np.ndarray, np.ndarray],
    given: tuple[np.ndarray, np.ndarray],
    result: tuple[np.ndarray, np.ndarray],
    k: int,
) -> None:
    """Send each channel's gradient to the edge that won it, and past the relu."""
    gradient, winner = found
    hidden, weight = given
    to_hidden, to_weight = result
    width = hidden.shape[1]
    for i in range(len(gradient)):
        for c in range(gradient.shape[1]):
            g = gradient[i, c]
            row = i * k + winner[i, c]
            for h in range(width):
                to_hidden[row, h] += g * weight[c, h]
                to_weight[c, h] += g * hidden[row, h]
        for row in range(i * k, i * k + k):
            for h in range(width):
                to_hidden[row, h] = to_hidden[row, h] if hidden[row, h] > 0.0 else np.float32(0.0)

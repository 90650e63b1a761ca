"""Products of points' features with weights, a tile of 64 columns at a time; compiled.

Four rows and two columns of the features at a time keep the
processor's units busy (measured: twice the speed of a row at a time).
"""

from typing import no_type_check

import numpy as np
from jaxtyping import Float32
from numba import njit

TILE = 64
PIECE = 64
FAST = {"contract", "nsz", "nnan", "reassoc"}
NORM_EPSILON = 1e-5


def packed(
    weight: Float32[np.ndarray, "D C"], bias: Float32[np.ndarray, "D"]
) -> tuple[Float32[np.ndarray, "T C 64"], Float32[np.ndarray, "64*T"]]:
    """Return a linear layer's weight as tiles of 64 outputs, and its bias; zeros fill them up."""
    width, tiles = len(weight), -(-len(weight) // TILE)
    columns = np.zeros((weight.shape[1], tiles * TILE), np.float32)
    columns[:, :width] = weight.T
    filled = np.zeros(tiles * TILE, np.float32)
    filled[:width] = bias
    tiled = columns.reshape(-1, tiles, TILE).transpose(1, 0, 2)
    return np.ascontiguousarray(tiled), filled


@njit(cache=True, nogil=True, fastmath=FAST)
@no_type_check
def linear(
    features: np.ndarray, column: int, layer: tuple[np.ndarray, np.ndarray], result: np.ndarray
) -> None:
    """Write ``features @ W.T + bias`` to ``result`` (M, 64 T).

    The ``layer`` (T, C, 64) is packed; the C features from ``column`` on count.
    """
    count = len(features)
    weight, bias = layer
    for piece in range((count + PIECE - 1) // PIECE):
        sums = np.empty((4, TILE), np.float32)
        for tile in range(len(weight)):  # one stays in the processor's first cache
            for begin in range(piece * PIECE, min((piece + 1) * PIECE, count), 4):
                four_products(features, (begin, column), weight[tile], sums)
                for r in range(min(4, count - begin)):
                    for c in range(TILE):
                        place = tile * TILE + c
                        result[begin + r, place] = sums[r, c] + bias[place]


@njit(cache=True, nogil=True, fastmath=FAST, inline="always")
@no_type_check
def four_products(
    rows: np.ndarray, corner: tuple[int, int], weight: np.ndarray, sums: np.ndarray
) -> None:
    """Write the products of four rows with one tile to ``sums``; the last row stands for more.

    ``corner`` is the first row and the first column that count.
    """
    begin, column = corner
    last, depth = len(rows) - 1, len(weight)
    r0, r1, r2, r3 = begin, min(begin + 1, last), min(begin + 2, last), min(begin + 3, last)
    for c in range(TILE):
        sums[0, c] = sums[1, c] = sums[2, c] = sums[3, c] = np.float32(0.0)
    for h in range(0, depth - 1, 2):
        a0, b0 = rows[r0, column + h], rows[r0, column + h + 1]
        a1, b1 = rows[r1, column + h], rows[r1, column + h + 1]
        a2, b2 = rows[r2, column + h], rows[r2, column + h + 1]
        a3, b3 = rows[r3, column + h], rows[r3, column + h + 1]
        for c in range(TILE):
            w, v = weight[h, c], weight[h + 1, c]
            sums[0, c] += a0 * w + b0 * v
            sums[1, c] += a1 * w + b1 * v
            sums[2, c] += a2 * w + b2 * v
            sums[3, c] += a3 * w + b3 * v
    if depth % 2 == 1:
        h = depth - 1
        for c in range(TILE):
            sums[0, c] += rows[r0, column + h] * weight[h, c]
            sums[1, c] += rows[r1, column + h] * weight[h, c]
            sums[2, c] += rows[r2, column + h] * weight[h, c]
            sums[3, c] += rows[r3, column + h] * weight[h, c]


@njit(cache=True, nogil=True, fastmath=FAST)
@no_type_check
def write_normed(row: np.ndarray, norm: np.ndarray, result: np.ndarray, column: int) -> None:
    """Write ``relu(LayerNorm(row))`` to ``result`` from a column on; ``norm`` (2, D) as learned."""
    width = norm.shape[1]
    total = squares = np.float32(0.0)
    for c in range(width):
        total += row[c]
    mean = total / np.float32(width)
    for c in range(width):
        squares += (row[c] - mean) * (row[c] - mean)
    scale = np.float32(1.0) / np.sqrt(squares / np.float32(width) + np.float32(NORM_EPSILON))
    for c in range(width):
        value = (row[c] - mean) * scale * norm[0, c] + norm[1, c]
        result[column + c] = max(value, np.float32(0.0))

"""The network's blocks for reading only: each in one pass over the points; compiled.

The same numbers as :mod:`sl3d_slam.lines.network.edgeconv` and ``context`` to float32's rounding.
"""

from typing import no_type_check

import numpy as np
from numba import njit

from sl3d_slam.lines.network.products import FAST, PIECE, TILE, four_products, write_normed
from sl3d_slam.lines.network.shapes import HIDDEN


@njit(cache=True, nogil=True, fastmath=FAST)
@no_type_check
def offset_block(
    inputs: np.ndarray,
    first: tuple[np.ndarray, np.ndarray],
    second: tuple[np.ndarray, np.ndarray],
    norm: np.ndarray,
    result: np.ndarray,
) -> None:
    """Write the first block's features to ``result``: OffsetConv of ``inputs`` (M, k, C).

    ``first`` is its hidden layer, ``second`` the layer behind that; both packed.
    """
    count, k = inputs.shape[:2]
    for piece in range((count + PIECE - 1) // PIECE):
        hidden, sums = np.empty((k, HIDDEN), np.float32), np.empty((4, TILE), np.float32)
        row = np.empty(len(second[1]), np.float32)
        for i in range(piece * PIECE, min((piece + 1) * PIECE, count)):
            _hidden_layer(inputs[i], first, hidden, sums)
            for tile in range(len(second[0])):
                _largest_products(hidden, second[0][tile], sums, row[tile * TILE :])
            for c in range(len(row)):
                row[c] += second[1][c]
            write_normed(row, norm, result[i], 0)


@njit(cache=True, nogil=True, fastmath=FAST, inline="always")
@no_type_check
def _hidden_layer(
    edges: np.ndarray, layer: tuple[np.ndarray, np.ndarray], hidden: np.ndarray, sums: np.ndarray
) -> None:
    weight, bias = layer
    for j in range(0, len(edges), 4):
        four_products(edges, (j, 0), weight[0], sums)
        for r in range(min(4, len(edges) - j)):
            for h in range(HIDDEN):
                hidden[j + r, h] = max(sums[r, h] + bias[h], np.float32(0.0))


@njit(cache=True, nogil=True, fastmath=FAST, inline="always")
@no_type_check
def _largest_products(
    hidden: np.ndarray, weight: np.ndarray, sums: np.ndarray, largest: np.ndarray
) -> None:
    """Write the largest product of any edge with one tile to the front of ``largest``."""
    for c in range(TILE):
        largest[c] = -np.inf
    for j in range(0, len(hidden), 4):
        four_products(hidden, (j, 0), weight, sums)
        for c in range(TILE):
            value = max(max(largest[c], sums[0, c]), sums[1, c])
            largest[c] = max(max(value, sums[2, c]), sums[3, c])


@njit(cache=True, nogil=True, fastmath=FAST)
@no_type_check
def edge_block(
    products: np.ndarray,
    neighbours: np.ndarray,
    norm: np.ndarray,
    result: np.ndarray,
    column: int,
) -> None:
    """Write the features of a later block to ``result``, D from ``column`` on: EdgeConv, cheaply.

    ``products`` (M, 2 W) are ``(W1 - W2) x_i`` and ``W2 x_i``, each filled up to whole tiles.
    """
    count, width = len(neighbours), products.shape[1] // 2
    for piece in range((count + PIECE - 1) // PIECE):
        row = np.empty(width, np.float32)
        for i in range(piece * PIECE, min((piece + 1) * PIECE, count)):
            _largest_rows(products, neighbours[i], row)
            for c in range(width):
                row[c] += products[i, c]
            write_normed(row, norm, result[i], column)


@njit(cache=True, nogil=True, fastmath=FAST, inline="always")
@no_type_check
def _largest_rows(products: np.ndarray, neighbours: np.ndarray, largest: np.ndarray) -> None:
    """Write the largest of the second halves of the neighbours' products to ``largest``."""
    k, width = len(neighbours), len(largest)
    for c in range(width):
        largest[c] = -np.inf
    for j in range(k % 4):
        n = neighbours[j]
        for c in range(width):
            largest[c] = max(largest[c], products[n, width + c])
    for j in range(k % 4, k, 4):  # four at a time: less than half the time of one by one
        n0, n1, n2, n3 = neighbours[j], neighbours[j + 1], neighbours[j + 2], neighbours[j + 3]
        for c in range(width):
            value = max(largest[c], products[n0, width + c])
            value = max(value, products[n1, width + c])
            value = max(value, products[n2, width + c])
            largest[c] = max(value, products[n3, width + c])


@njit(cache=True, nogil=True)
@no_type_check
def cell_maxima(
    features: np.ndarray, width: int, cell_of: np.ndarray, num_cells: int
) -> np.ndarray:
    """Return per cell (K, width) the largest of its points' first features, zero at least."""
    pooled = np.zeros((num_cells, width), np.float32)
    for i in range(len(features)):
        cell = cell_of[i]
        for c in range(width):
            pooled[cell, c] = max(pooled[cell, c], features[i, c])
    return pooled


@njit(cache=True, nogil=True, fastmath=FAST)
@no_type_check
def heard_of_cells(
    products: np.ndarray, neighbours: np.ndarray, gaps: np.ndarray, gap_weight: np.ndarray
) -> np.ndarray:
    """Return per cell the largest of what its neighbours tell it: CellConv before its mixing.

    ``products`` (K, 2 W) are what a cell is and what it tells; ``gap_weight`` (2, D).
    """
    count, k = neighbours.shape
    width, behind = gap_weight.shape[1], products.shape[1] // 2
    result = np.empty((count, width), np.float32)
    largest = np.empty(width, np.float32)
    for i in range(count):
        for c in range(width):
            largest[c] = -np.inf
        for j in range(k):
            n, across, up = neighbours[i, j], gaps[i, j, 0], gaps[i, j, 1]
            for c in range(width):
                told = products[n, behind + c] + across * gap_weight[0, c] + up * gap_weight[1, c]
                largest[c] = max(largest[c], told)
        for c in range(width):
            result[i, c] = max(largest[c] + products[i, c], np.float32(0.0))
    return result


@njit(cache=True, nogil=True, fastmath=FAST)
@no_type_check
def normed(rows: np.ndarray, norm: np.ndarray) -> np.ndarray:
    """Return ``relu(LayerNorm(rows))`` (N, D); what rows hold beyond D does not count."""
    result = np.empty((len(rows), norm.shape[1]), np.float32)
    for i in range(len(rows)):
        write_normed(rows[i], norm, result[i], 0)
    return result


@njit(cache=True, nogil=True, fastmath=FAST)
@no_type_check
def line_probability(
    own: np.ndarray,
    wide: np.ndarray,
    cell_of: np.ndarray,
    contrast: tuple[np.ndarray, float],
    column: int,
) -> np.ndarray:
    """Return the probability of the second class from the segmentation head's hidden layer.

    The layer is ``relu(own[i] + wide[cell_of[i]])``, in ``own`` from ``column`` on; ``contrast`` is
    the second logit's weight (D,) and bias less the first's.
    """
    weight, bias = contrast
    probability = np.empty(len(own), np.float32)
    for i in range(len(own)):
        cell = cell_of[i]
        logit = np.float32(0.0)
        for c in range(len(weight)):
            logit += weight[c] * max(own[i, column + c] + wide[cell, c], np.float32(0.0))
        probability[i] = 1.0 / (1.0 + np.exp(-np.float64(logit) - bias))
    return probability

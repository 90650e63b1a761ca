"""Offsets of neighbours, the network's only input; compiled."""

from typing import no_type_check

import numpy as np
from jaxtyping import Float32
from numba import njit

from sl3d_slam.lines.network.settings import NetworkSettings

MAX_HEIGHT_M = 12.0
HEIGHT_UNIT_M = 3.0


def edge_inputs(
    points: np.ndarray, neighbours: np.ndarray, settings: NetworkSettings
) -> Float32[np.ndarray, "M k C"]:
    """Return what the first block sees of each edge; ``points`` are x, y, z and maybe a height.

    Three numbers are the neighbour's offset in metres, in the axes of the settings. The six after
    Eq. 1 and 3 of the paper: ``f = sum_j (p - q_j) / sum_j |p - q_j|``, and
    ``(p - q_j) / sum_j |p - q_j| - f``. With heights, the point's own height is a fourth number.
    """
    with_heights = settings.heights and not settings.scale_invariant
    edges = np.empty((*neighbours.shape, 4 if with_heights else 3), np.float32)
    _write_offsets(points, neighbours, settings.axes == "own", edges)
    if settings.scale_invariant:
        return scale_free(edges)
    if with_heights:
        height = np.clip(points[:, 3], 0.0, MAX_HEIGHT_M) / HEIGHT_UNIT_M
        edges[:, :, 3] = height[:, None]
    return edges


def scale_free(offsets: Float32[np.ndarray, "M k 3"]) -> Float32[np.ndarray, "M k 6"]:
    """Return Eq. 1's ratio and each neighbour's difference to it; scaling the cloud cancels."""
    lengths = np.linalg.norm(offsets, axis=2).sum(axis=1)
    shares = -offsets / np.maximum(lengths, 1e-9)[:, None, None]
    ratio = np.broadcast_to(shares.sum(axis=1, keepdims=True), shares.shape)
    return np.concatenate([ratio, shares - ratio], axis=2).astype(np.float32)


@njit(cache=True, nogil=True)
@no_type_check
def _write_offsets(
    points: np.ndarray, neighbours: np.ndarray, own_axes: bool, edges: np.ndarray
) -> None:
    """Write offsets to ``edges`` (M, k, 3 or more), turned about z into own axes if asked.

    Those are the horizontal principal directions of a neighbourhood's offsets, each pointing to
    the side that their mean lies on, so that they turn with the cloud.
    """
    count, k = neighbours.shape
    for i in range(count):
        for j in range(k):
            for axis in range(3):
                edges[i, j, axis] = points[neighbours[i, j], axis] - points[i, axis]
        if own_axes:
            _turn(edges[i])


@njit(cache=True, nogil=True)
@no_type_check
def _turn(offsets: np.ndarray) -> None:
    mx = my = xx = yy = xy = 0.0
    for j in range(len(offsets)):
        x, y = offsets[j, 0], offsets[j, 1]
        mx, my = mx + x, my + y
        xx, yy, xy = xx + x * x, yy + y * y, xy + x * y
    n = len(offsets)
    xx, yy, xy = xx - mx * mx / n, yy - my * my / n, xy - mx * my / n
    angle = 0.5 * np.arctan2(2.0 * xy, xx - yy)
    along_x, along_y = np.cos(angle), np.sin(angle)
    if mx * along_x + my * along_y < 0.0:
        along_x, along_y = -along_x, -along_y
    across_x, across_y = -along_y, along_x
    if mx * across_x + my * across_y < 0.0:
        across_x, across_y = -across_x, -across_y
    for j in range(len(offsets)):
        x, y = offsets[j, 0], offsets[j, 1]
        offsets[j, 0] = x * along_x + y * along_y
        offsets[j, 1] = x * across_x + y * across_y

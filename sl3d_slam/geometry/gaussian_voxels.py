"""Voxels that hold the mean and the covariance of the surfaces in them; compiled.

What small_gicp's ``GaussianVoxelMap`` keeps, kept where :mod:`robust_gicp` looks it up: its Python
interface hands out copies of all voxels, which a map of 30,000 pays with every scan. A point with
normal n has a plane's covariance, I - (1 - f) n n' (Segal et al., RSS 2009, f = 0.001).
"""

from typing import NamedTuple, no_type_check

import numpy as np
import small_gicp
from jaxtyping import Bool, Float64, Int32, Int64
from numba import njit

from sl3d_slam.geometry.se3 import Transform
from sl3d_slam.geometry.voxel_table import new_table, slot_of, voxel_key

VOXEL_M = 1.0
FORGETTING_CYCLE = 10  # insertions
FLATNESS = 1.0 - 1e-3


class Surfaces(NamedTuple):
    """Points and the normals of the surfaces they lie on, zero where there is none."""

    points: Float64[np.ndarray, "N 3"]
    normals: Float64[np.ndarray, "N 3"]

    @classmethod
    def of(cls, cloud: small_gicp.PointCloud) -> "Surfaces":
        """Take them out of a cloud with normals."""
        if cloud.size() == 0:
            return cls(np.zeros((0, 3)), np.zeros((0, 3)))
        parts = (cloud.points(), cloud.normals())
        return cls(*(np.ascontiguousarray(part[:, :3]) for part in parts))


class Voxels(NamedTuple):
    """Voxels in the first rows of arrays with room for more, and the table that finds them.

    ``covariances`` are xx, xy, xz, yy, yz, zz; ``touched`` tells at which insertion a point came
    last.
    """

    means: Float64[np.ndarray, "V 3"]
    covariances: Float64[np.ndarray, "V 6"]
    counts: Int64[np.ndarray, "V"]
    touched: Int64[np.ndarray, "V"]
    keys: Int64[np.ndarray, "V"]
    table: Int32[np.ndarray, "T"]


class GaussianVoxels:
    """A map of voxels of a metre; those that ``memory`` insertions did not touch are forgotten."""

    def __init__(self, memory: int | None = None) -> None:
        self._memory = memory
        self._insertions = 0
        self._size = 0
        self._rows = _with_room(0)

    def __len__(self) -> int:
        """Return the number of voxels."""
        return self._size

    @property
    def rows(self) -> Voxels:
        """The voxels as they are kept; not to be changed."""
        return self._rows

    def insert(self, surfaces: Surfaces, T_map_lidar: Transform) -> None:
        """Add points with normals."""
        needed = self._size + len(surfaces.points)
        if needed > len(self._rows.keys):
            self._rows = _moved(self._rows, np.arange(self._size), 2 * needed)
        self._size = _insert(
            self._rows,
            self._size,
            surfaces.points,
            surfaces.normals,
            np.ascontiguousarray(T_map_lidar),
            self._insertions,
        )
        self._insertions += 1
        if self._memory is not None and self._insertions % FORGETTING_CYCLE == 0:
            self._forget(self._rows.touched[: self._size] + self._memory >= self._insertions)

    def _forget(self, kept: Bool[np.ndarray, "V"]) -> None:
        rows = np.flatnonzero(kept)
        self._rows = _moved(self._rows, rows, len(self._rows.keys))
        self._size = len(rows)


def _with_room(count: int) -> Voxels:
    counts, touched, keys = (np.empty(count, np.int64) for _ in range(3))
    table = new_table(count)
    return Voxels(np.empty((count, 3)), np.empty((count, 6)), counts, touched, keys, table)


def _moved(voxels: Voxels, rows: Int64[np.ndarray, "K"], room: int) -> Voxels:
    """Return some of the voxels, in arrays with so much room."""
    moved = _with_room(room)
    for old, new in zip(voxels[:-1], moved[:-1], strict=True):
        new[: len(rows)] = old[rows]
    _enter(moved.keys, moved.table, len(rows))
    return moved


@njit(cache=True, nogil=True)
@no_type_check
def _enter(keys: np.ndarray, table: np.ndarray, size: int) -> None:
    """Enter the first rows in an empty table."""
    for row in range(size):
        table[slot_of(table, keys, keys[row])] = row


@njit(cache=True, nogil=True)
@no_type_check
def _insert(
    voxels: Voxels, size: int, points: np.ndarray, normals: np.ndarray, T: np.ndarray, now: int
) -> int:
    """Add points to the running means of their voxels; return how many voxels there are then."""
    p, n = np.empty(3), np.empty(3)
    for i in range(len(points)):
        for k in range(3):
            p[k] = T[k, 0] * points[i, 0] + T[k, 1] * points[i, 1] + T[k, 2] * points[i, 2]
            p[k] += T[k, 3]
            n[k] = T[k, 0] * normals[i, 0] + T[k, 1] * normals[i, 1] + T[k, 2] * normals[i, 2]
        key = voxel_key(p[0], p[1], p[2], VOXEL_M)
        slot = slot_of(voxels.table, voxels.keys, key)
        row = voxels.table[slot]
        if row < 0:
            row, size = size, size + 1
            voxels.table[slot], voxels.keys[row], voxels.counts[row] = row, key, 0
            voxels.means[row], voxels.covariances[row] = 0.0, 0.0
        voxels.counts[row] += 1
        voxels.touched[row] = now
        share, column = 1.0 / voxels.counts[row], 0
        for k in range(3):
            voxels.means[row, k] += share * (p[k] - voxels.means[row, k])
            for j in range(k, 3):
                own = (k == j) - FLATNESS * n[k] * n[j]
                voxels.covariances[row, column] += share * (own - voxels.covariances[row, column])
                column += 1
    return size

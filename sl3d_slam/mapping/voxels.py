"""What stands in a map, as voxels: occupied in several keyframes, coded in about three bytes each.

Space is cut into columns of 40 x 40 voxels; within one, voxels are counted row by row, layer by
layer, and the sorted numbers are kept as differences. Each voxel also keeps the mean of its points
to a 32nd of its edge, since voxel centres alone would turn walls into stairs.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Float64, Int64, UInt8, UInt16

from sl3d_slam.geometry.se3 import Points, Transform, transform_points
from sl3d_slam.mapping.varint import pack, unpack

BLOCK_VOXELS = 40
LEVELS = 32  # steps of a mean within its voxel, along each axis
BATCH = 64
HALF_RANGE = 1 << 20  # voxels along each axis: 21 bits


class Voxels(NamedTuple):
    """Occupied voxels by sorted key, the sum and number of their points, and in how many scans."""

    keys: Int64[np.ndarray, "V"]
    sums: Float64[np.ndarray, "V 3"]
    points: Int64[np.ndarray, "V"]
    keyframes: Int64[np.ndarray, "V"]


@dataclass(frozen=True, slots=True, eq=False)
class VoxelCloud:
    """The occupied voxels of a map, decoded where asked for.

    Attributes
    ----------
    voxel_m : edge of a voxel, metres.
    blocks : (B, 3) int64, column of each block (x, y) and its lowest layer (z), in voxels / 40 for
        x and y and in voxels for z; sorted by x, then y.
    starts : (B + 1,) int64, where the voxels of each block begin in ``means``.
    key_starts : (B + 1,) int64, where the coded numbers of each block begin in ``keys``.
    keys : (S,) uint8, differences of sorted voxel numbers, as :func:`pack` codes them.
    means : (V,) uint16, the mean of the points in each voxel, five bits an axis.
    """

    voxel_m: float
    blocks: Int64[np.ndarray, "B 3"]
    starts: Int64[np.ndarray, "O"]
    key_starts: Int64[np.ndarray, "O"]
    keys: UInt8[np.ndarray, "S"]
    means: UInt16[np.ndarray, "V"]

    def __len__(self) -> int:
        """Return the number of voxels."""
        return len(self.means)

    def near(
        self, position: Float64[np.ndarray, "3"], radius_m: float
    ) -> Float32[np.ndarray, "M 3"]:
        """Return the points, in the map frame, less than ``radius_m`` away as seen from above."""
        edge_m = BLOCK_VOXELS * self.voxel_m
        first, last = (np.floor((position[0] + s * radius_m) / edge_m) for s in (-1, 1))
        rows = slice(*np.searchsorted(self.blocks[:, 0], [first, last + 1]))
        low = self.blocks[rows, :2] * edge_m
        nearest = np.clip(position[:2], low, low + edge_m)
        touched = np.flatnonzero(np.linalg.norm(nearest - position[:2], axis=1) <= radius_m)
        touched += rows.start
        points = self._decoded(touched)
        return points[np.hypot(*(points[:, :2] - position[:2]).T) < radius_m].astype(np.float32)

    def all_points(self) -> Float32[np.ndarray, "V 3"]:
        """Return every point, in the map frame."""
        return self._decoded(self._all()).astype(np.float32)

    def transformed(self, T_new_map: Transform) -> "VoxelCloud":
        """Express the points in another frame and cut them into voxels anew."""
        return join_clouds([transform_points(T_new_map, self._decoded(self._all()))], self.voxel_m)

    def _all(self) -> Int64[np.ndarray, "B"]:
        return np.arange(len(self.blocks))

    def _decoded(self, chosen: Int64[np.ndarray, "C"]) -> Float64[np.ndarray, "M 3"]:
        parts = [self._blocks(chosen[k : k + BATCH]) for k in range(0, len(chosen), BATCH)]
        return np.concatenate([np.zeros((0, 3)), *parts])

    def _blocks(self, chosen: Int64[np.ndarray, "C"]) -> Float64[np.ndarray, "M 3"]:
        ends = chosen + 1
        count = self.starts[ends] - self.starts[chosen]
        steps = unpack(_slices(self.keys, self.key_starts[chosen], self.key_starts[ends]))
        total = np.cumsum(steps)
        before = np.concatenate([[0], total])[np.cumsum(count) - count]
        means = _slices(self.means, self.starts[chosen], self.starts[ends]).astype(np.int64)
        corner = self.blocks[chosen] * (BLOCK_VOXELS, BLOCK_VOXELS, 1)
        layer, cell = np.divmod(total - np.repeat(before, count), BLOCK_VOXELS**2)
        index = np.stack([cell % BLOCK_VOXELS, cell // BLOCK_VOXELS, layer], axis=1)
        level = means[:, None] // (1, LEVELS, LEVELS**2) % LEVELS
        return (index + np.repeat(corner, count, axis=0) + (level + 0.5) / LEVELS) * self.voxel_m


def _slices(
    values: np.ndarray, starts: Int64[np.ndarray, "C"], ends: Int64[np.ndarray, "C"]
) -> np.ndarray:
    """Return some stretches of an array, one after the other."""
    parts = [values[a:b] for a, b in zip(starts.tolist(), ends.tolist(), strict=True)]
    return np.concatenate([values[:0], *parts])


def collect_voxels(
    clouds: Iterable[np.ndarray], T_map_keyframe: Float64[np.ndarray, "K 4 4"], voxel_m: float
) -> Voxels:
    """Add up the clouds of all keyframes (each in its lidar frame), one at a time."""
    total, batch = _no_voxels(), []
    for cloud, T_map_lidar in zip(clouds, T_map_keyframe, strict=True):
        batch.append(_voxels_of_scan(cloud, T_map_lidar, voxel_m))
        if len(batch) == BATCH:
            total, batch = add_voxels([total, *batch]), []
    return add_voxels([total, *batch])


def add_voxels(parts: list[Voxels]) -> Voxels:
    """Join counts of the same voxels."""
    keys, inverse = np.unique(np.concatenate([part.keys for part in parts]), return_inverse=True)
    sums = np.concatenate([part.sums for part in parts])
    added = np.empty((len(keys), 3))
    for axis in range(3):
        added[:, axis] = np.bincount(inverse, weights=sums[:, axis], minlength=len(keys))
    points, keyframes = np.zeros((2, len(keys)), np.int64)
    np.add.at(points, inverse, np.concatenate([part.points for part in parts]))
    np.add.at(keyframes, inverse, np.concatenate([part.keyframes for part in parts]))
    return Voxels(keys, added, points, keyframes)


def code_voxels(voxels: Voxels, voxel_m: float, min_keyframes: int) -> VoxelCloud:
    """Keep the voxels that enough keyframes saw, in the form that the map file holds."""
    kept = voxels.keyframes >= min_keyframes
    index = _unfold(voxels.keys[kept])
    means = voxels.sums[kept] / voxels.points[kept][:, None] / voxel_m
    level = np.clip(np.floor((means - index) * LEVELS), 0, LEVELS - 1).astype(np.int64)
    column = index[:, :2] // BLOCK_VOXELS
    columns, block = np.unique(column, axis=0, return_inverse=True)
    block = block.ravel()
    floor = np.full(len(columns), np.iinfo(np.int64).max)
    np.minimum.at(floor, block, index[:, 2])
    cell = index[:, :2] - column * BLOCK_VOXELS
    number = (index[:, 2] - floor[block]) * BLOCK_VOXELS**2 + cell[:, 1] * BLOCK_VOXELS + cell[:, 0]
    order = np.lexsort((number, block))
    starts = np.searchsorted(block[order], np.arange(len(columns) + 1))
    step = np.diff(number[order], prepend=0)
    step[starts[:-1]] = number[order][starts[:-1]]
    parts = [pack(step[a:b]) for a, b in pairwise(starts)]
    return VoxelCloud(
        voxel_m=voxel_m,
        blocks=np.column_stack([columns, floor]).astype(np.int64),
        starts=starts.astype(np.int64),
        key_starts=np.cumsum([0, *(len(part) for part in parts)]).astype(np.int64),
        keys=np.concatenate([np.zeros(0, np.uint8), *parts]),
        means=(level[order] @ (1, LEVELS, LEVELS**2)).astype(np.uint16),
    )


def join_clouds(clouds: Iterable[np.ndarray], voxel_m: float) -> VoxelCloud:
    """Keep every voxel that a cloud (all in one frame) has a point in."""
    parts = [_voxels_of_scan(cloud, np.eye(4), voxel_m) for cloud in clouds]
    return code_voxels(add_voxels([_no_voxels(), *parts]), voxel_m, 1)


def _no_voxels() -> Voxels:
    none = np.zeros(0, np.int64)
    return Voxels(none, np.zeros((0, 3)), none, none)


def _voxels_of_scan(cloud: np.ndarray, T_map_lidar: Transform, voxel_m: float) -> Voxels:
    points = transform_points(T_map_lidar, cloud.astype(np.float64))
    keys, inverse, count = np.unique(
        voxel_keys(points, voxel_m), return_inverse=True, return_counts=True
    )
    sums = np.empty((len(keys), 3))
    for axis in range(3):
        sums[:, axis] = np.bincount(inverse, weights=points[:, axis], minlength=len(keys))
    return Voxels(keys, sums, count.astype(np.int64), np.ones(len(keys), np.int64))


def voxel_keys(points: Points, voxel_m: float) -> Int64[np.ndarray, "N"]:
    """Return one number for the voxel of each point, from its three indices."""
    index = np.floor(points / voxel_m).astype(np.int64) + HALF_RANGE
    if len(index) and (index.min() < 0 or index.max() >= 2 * HALF_RANGE):
        raise ValueError(f"a point lies more than {HALF_RANGE} voxels from the map's origin")
    return (index[:, 0] << 42) | (index[:, 1] << 21) | index[:, 2]


def _unfold(keys: Int64[np.ndarray, "V"]) -> Int64[np.ndarray, "V 3"]:
    mask = 2 * HALF_RANGE - 1
    return np.stack([keys >> 42, (keys >> 21) & mask, keys & mask], axis=1) - HALF_RANGE

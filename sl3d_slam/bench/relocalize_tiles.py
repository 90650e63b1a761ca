"""Large maps made of small ones: towns laid out side by side, no two of them alike.

The towns that are asked for stand in the map once, as they are. The rest of it is the same towns
stretched by 6 to 25 % along both axes, each time by other factors, half of them mirrored: as rich
in lines as a town, and nowhere the shape of one.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from sl3d_slam.geometry.se3 import Transform, make_transform
from sl3d_slam.mapping.build import join_lines
from sl3d_slam.mapping.line_map import LineMap
from sl3d_slam.mapping.voxels import BLOCK_VOXELS, VoxelCloud, join_clouds

STRETCH = (0.06, 0.25)
CLOUDS_A_TOWN = 8
GAP_M = 150.0


class Tile(NamedTuple):
    """A town in the large map, and where its frame lies there."""

    line_map: LineMap
    T_map_tile: Transform


def lay_out(towns: list[LineMap], num_lines: int, seed: int) -> tuple[LineMap, list[Transform]]:
    """Return a map of about so many lines, and where each town as it is lies in it."""
    rng = np.random.default_rng([seed, num_lines])
    clouds = [
        [_stretched(town, _factors(rng)).cloud for _ in range(CLOUDS_A_TOWN)] for town in towns
    ]
    maps = list(towns)
    while sum(map(len, maps)) < num_lines:
        town = len(maps) % len(towns)
        lines = _stretched(replace(towns[town], cloud=None), _factors(rng))
        maps.append(replace(lines, cloud=clouds[town][rng.integers(CLOUDS_A_TOWN)]))
    order = rng.permutation(len(maps))
    edge_m = BLOCK_VOXELS * _cloud(towns[0]).voxel_m
    pitch_m = edge_m * np.ceil((max(map(_extent_m, towns)) * (1 + STRETCH[1]) + GAP_M) / edge_m)
    width = int(np.ceil(np.sqrt(len(maps))))
    corners = pitch_m * np.stack([order // width, order % width, np.zeros(len(order))], axis=1)
    tiles = [
        Tile(line_map, make_transform(np.eye(3), corner))
        for line_map, corner in zip(maps, corners, strict=True)
    ]
    return _joined(tiles), [tile.T_map_tile for tile in tiles[: len(towns)]]


def _factors(rng: np.random.Generator) -> Float64[np.ndarray, "3"]:
    size = rng.uniform(*STRETCH, 2)
    stretch = np.where(rng.random(2) < 0.5, 1.0 - size, 1.0 + size)
    return np.array([stretch[0], stretch[1] * rng.choice([-1.0, 1.0]), 1.0])


def _stretched(line_map: LineMap, factors: Float64[np.ndarray, "3"]) -> LineMap:
    """Stretch everything in a map; where it is mirrored, so are the frames of its sensors."""
    mirror = np.diag(np.sign(factors))
    poses = line_map.T_map_keyframe.copy()
    poses[:, :3, :3] = mirror @ poses[:, :3, :3] @ mirror
    poses[:, :3, 3] *= factors
    cloud = line_map.cloud
    return replace(
        line_map,
        lines=replace(line_map.lines, endpoints=line_map.lines.endpoints * factors),
        T_map_keyframe=poses,
        keyframe_up=line_map.keyframe_up @ mirror,
        cloud=None if cloud is None else join_clouds([cloud.all_points() * factors], cloud.voxel_m),
    )


def _extent_m(line_map: LineMap) -> float:
    """Return twice the farthest reach of a town from its frame, along an axis."""
    points = _cloud(line_map).all_points()
    return 2.0 * float(np.abs(points[:, :2]).max())


def _cloud(line_map: LineMap) -> VoxelCloud:
    assert line_map.cloud is not None  # towns are mapped with their clouds
    return line_map.cloud


def _joined(tiles: list[Tile]) -> LineMap:
    """Join maps that do not touch."""
    maps = [tile.line_map for tile in tiles]
    first_line = np.cumsum([0, *map(len, maps)])
    first_sighting = np.cumsum([0, *(len(one.indices) for one in maps)])
    offsets = [one.offsets[:-1] + start for one, start in zip(maps, first_sighting, strict=False)]
    return LineMap(
        lines=join_lines([one.lines.transformed(T) for one, T in tiles]),
        T_map_keyframe=np.concatenate([T @ one.T_map_keyframe for one, T in tiles]),
        keyframe_up=np.concatenate([one.keyframe_up for one in maps]),
        offsets=np.concatenate([*offsets, first_sighting[-1:]]).astype(np.int64),
        indices=np.concatenate(
            [one.indices + start for one, start in zip(maps, first_line, strict=False)]
        ),
        cloud=_joined_clouds(tiles),
        origin=maps[0].origin,
    )


def _joined_clouds(tiles: list[Tile]) -> VoxelCloud:
    """Join clouds whose frames lie whole blocks apart; the coded voxels stay as they are."""
    clouds = [_cloud(tile.line_map) for tile in tiles]
    edge_m = BLOCK_VOXELS * clouds[0].voxel_m
    blocks, counts, keys, means = [], [], [], []
    for cloud, tile in zip(clouds, tiles, strict=True):
        shift = np.rint(tile.T_map_tile[:3, 3] / edge_m).astype(np.int64) * (1, 1, 0)
        blocks.append(cloud.blocks + shift)
        counts.append(np.stack([np.diff(cloud.starts), np.diff(cloud.key_starts)], axis=1))
        keys += np.split(cloud.keys, cloud.key_starts[1:-1])
        means += np.split(cloud.means, cloud.starts[1:-1])
    block = np.concatenate(blocks)
    order = np.lexsort((block[:, 1], block[:, 0]))
    ends = np.cumsum(np.concatenate(counts)[order], axis=0)
    return VoxelCloud(
        voxel_m=clouds[0].voxel_m,
        blocks=block[order],
        starts=np.concatenate([[0], ends[:, 0]]),
        key_starts=np.concatenate([[0], ends[:, 1]]),
        keys=np.concatenate([keys[k] for k in order]),
        means=np.concatenate([means[k] for k in order]),
    )

"""A line map as named arrays of small integers, and back, with every count checked."""

import numpy as np
from jaxtyping import Float64, Int64
from scipy.spatial.transform import Rotation

from sl3d_slam.mapping.build import Sightings, by_keyframe
from sl3d_slam.mapping.line_map import LineMap, MapOrigin
from sl3d_slam.mapping.quantise import BITS, quantise, restore, steps_of
from sl3d_slam.mapping.varint import pack, pack_table, unpack, unpack_table
from sl3d_slam.mapping.voxels import BLOCK_VOXELS, LEVELS, VoxelCloud
from sl3d_slam.types import LineKind, LineSet

Tensors = dict[str, np.ndarray]

METRE = 1000  # steps in a metre
RADIAN = 100_000
UNIT = 10_000  # steps in a unit vector's component
FURTHEST_M = 1e8
CHECKED_BLOCKS = 1024  # at once, so that a large cloud stays on disk
LAYOUT = {
    "endpoints": ("uint8", 1),
    "num_points": ("uint8", 1),
    "kinds": ("uint8", 1),
    "scores": ("uint8", 1),
    "descriptors": ("uint8", 2),
    "descriptor_scales": ("float32", 1),
    "poses": ("uint8", 1),
    "up": ("uint8", 1),
    "support": ("uint8", 1),
    "seen_by": ("uint8", 1),
}
CLOUD_LAYOUT = {
    "cloud_blocks": ("uint8", 1),
    "cloud_keys": ("uint8", 1),
    "cloud_means": ("uint16", 1),
}
CODING = {
    "endpoints": "table of x y z of one end, then steps to the other, in mm",
    "num_points": "table of one column",
    "scores": "255 is 1",
    "descriptors": f"{BITS} bits an entry, low bit first, from the high bit of each byte; less "
    f"{steps_of(BITS)}, times descriptor_scales, then made unit length",
    "poses": "table of x y z in mm, rotation vector in 1e-5 rad",
    "up": "table of x y z in 1e-4",
    "support": "list: how many keyframes saw each landmark",
    "seen_by": "list: for each landmark the first keyframe, then steps to the next, less one",
    "table": "signed steps from row to row (zigzag), as a list",
    "list": "integers of seven bits a byte, low bits first, high bit set where more follow",
}
CLOUD_CODING = {
    "cloud_blocks": f"table of column x, column y (of {BLOCK_VOXELS} x {BLOCK_VOXELS} voxels), "
    "lowest layer, number of voxels, bytes in cloud_keys",
    "cloud_keys": f"list for each block: steps between sorted (z * {BLOCK_VOXELS} + y) * "
    f"{BLOCK_VOXELS} + x",
    "cloud_means": f"mean of the points in the voxel, x + {LEVELS} y + {LEVELS**2} z, "
    f"in 1/{LEVELS} of its edge",
}


def map_tensors(line_map: LineMap) -> Tensors:
    """Return the arrays of the file, all integers but the scales of the descriptors."""
    lines = line_map.lines
    if not line_map.support.all():
        raise ValueError("each landmark needs a keyframe that saw it")
    descriptors, scales = quantise(lines.descriptors)
    start, end = _steps(lines.endpoints[:, 0], METRE), _steps(lines.endpoints[:, 1], METRE)
    position = _steps(line_map.T_map_keyframe[:, :3, 3], METRE)
    turn = Rotation.from_matrix(line_map.T_map_keyframe[:, :3, :3]).as_rotvec()
    tensors = {
        "endpoints": pack_table(np.concatenate([start, end - start], axis=1)),
        "num_points": pack_table(lines.num_points[:, None]),
        "kinds": lines.kinds,
        "scores": np.rint(np.clip(lines.scores, 0, 1) * 255).astype(np.uint8),
        "descriptors": descriptors,
        "descriptor_scales": scales,
        "poses": pack_table(np.concatenate([position, _steps(turn, RADIAN)], axis=1)),
        "up": pack_table(_steps(line_map.keyframe_up, UNIT)),
        "support": pack(line_map.support),
        "seen_by": pack(_first_and_gaps(line_map)),
    }
    return tensors if line_map.cloud is None else tensors | _cloud_tensors(line_map.cloud)


def map_of(
    tensors: Tensors, voxel_m: float | None, origin: MapOrigin, descriptor_bits: int = BITS
) -> LineMap:
    """Return the map that the arrays describe.

    Raises
    ------
    ValueError
        saying which array is not what it should be.
    """
    _check_layout(tensors, LAYOUT if voxel_m is None else LAYOUT | CLOUD_LAYOUT)
    lines = _lines_of(tensors, descriptor_bits)
    poses = _poses_of(tensors)
    up = unpack_table(tensors["up"], 3) / UNIT
    norm = np.linalg.norm(up, axis=1, keepdims=True)
    _require(len(up) == len(poses), "as many up vectors as poses")
    _require(bool(np.all(np.abs(norm - 1) < 0.01)), "up vectors of unit length")
    sightings = _sightings_of(tensors, len(lines), len(poses))
    offsets, indices = by_keyframe(sightings, len(poses))
    cloud = None if voxel_m is None else _cloud_of(tensors, voxel_m)
    return LineMap(lines, poses, up / norm, offsets, indices, cloud, origin)


def _steps(values: np.ndarray, per_unit: int) -> np.ndarray:
    """Round to whole steps; refuse what no map can hold."""
    if not np.all(np.abs(values) < FURTHEST_M):  # false for NaN too
        raise ValueError(f"coordinates must be finite and below {FURTHEST_M:.0e} m")
    return np.rint(values * per_unit).astype(np.int64)


def _first_and_gaps(line_map: LineMap) -> Int64[np.ndarray, "S"]:
    keyframe = np.repeat(np.arange(len(line_map.keyframe_up)), np.diff(line_map.offsets))
    order = np.lexsort((keyframe, line_map.indices))
    landmark, keyframe = line_map.indices[order], keyframe[order].astype(np.int64)
    if len(keyframe) == 0:
        return keyframe
    again = np.diff(landmark, prepend=-1) == 0
    return np.where(again, np.diff(keyframe, prepend=0) - 1, keyframe)


def _cloud_tensors(cloud: VoxelCloud) -> Tensors:
    sizes = np.stack([np.diff(cloud.starts), np.diff(cloud.key_starts)], axis=1)
    return {
        "cloud_blocks": pack_table(np.concatenate([cloud.blocks, sizes], axis=1)),
        "cloud_keys": cloud.keys,
        "cloud_means": cloud.means,
    }


def _require(condition: bool, what: str) -> None:
    if not condition:
        raise ValueError(f"expected {what}")


def _check_layout(tensors: Tensors, layout: dict[str, tuple[str, int]]) -> None:
    _require(set(tensors) == set(layout), f"the arrays {', '.join(sorted(layout))}")
    for name, (dtype, rank) in layout.items():
        found = tensors[name]
        _require(found.dtype == dtype and found.ndim == rank, f"{name} as {dtype} of rank {rank}")


def _lines_of(tensors: Tensors, descriptor_bits: int) -> LineSet:
    table = unpack_table(tensors["endpoints"], 6)
    start = table[:, :3] / METRE
    endpoints = np.stack([start, start + table[:, 3:] / METRE], axis=1)
    count = len(tensors["descriptors"])
    num_points = unpack_table(tensors["num_points"], 1)[:, 0]
    columns = (table, num_points, tensors["kinds"], tensors["scores"])
    _require(all(len(column) == count for column in columns), "a row a landmark in each array")
    _require(bool(np.all(np.abs(table) < FURTHEST_M * METRE)), "end points on this planet")
    _require(bool(np.all(tensors["kinds"] < len(LineKind))), f"kinds below {len(LineKind)}")
    _require(bool(np.all(num_points >= 0)), "numbers of points of at least 0")
    scales = tensors["descriptor_scales"]
    _require(bool(np.all((scales > 1e-30) & (scales < 1e6))), "positive scales of descriptors")
    return LineSet(
        endpoints=endpoints,
        descriptors=restore(tensors["descriptors"], scales, descriptor_bits),
        num_points=num_points,
        kinds=tensors["kinds"],
        scores=(tensors["scores"] / np.float32(255)).astype(np.float32),
    )


def _poses_of(tensors: Tensors) -> Float64[np.ndarray, "K 4 4"]:
    table = unpack_table(tensors["poses"], 6)
    _require(bool(np.all(np.abs(table[:, :3]) < FURTHEST_M * METRE)), "poses on this planet")
    _require(bool(np.all(np.abs(table[:, 3:]) < 4 * RADIAN)), "rotations of at most half a turn")
    poses = np.tile(np.eye(4), (len(table), 1, 1))
    if len(table):
        poses[:, :3, :3] = Rotation.from_rotvec(table[:, 3:] / RADIAN).as_matrix()
    poses[:, :3, 3] = table[:, :3] / METRE
    return poses


def _sightings_of(tensors: Tensors, num_lines: int, num_keyframes: int) -> Sightings:
    support, codes = unpack(tensors["support"]), unpack(tensors["seen_by"])
    _require(len(support) == num_lines, "a support count a landmark")
    _require(bool(np.all(support > 0)), "landmarks that were seen")
    _require(bool(support.sum() == len(codes)), "as many sightings as the support counts say")
    landmark = np.repeat(np.arange(num_lines), support).astype(np.int64)
    first = np.cumsum(support) - support
    total = np.cumsum(codes + 1)
    keyframe = total - np.repeat(total[first] - codes[first], support)
    _require(bool(np.all(keyframe < num_keyframes)), f"keyframes below {num_keyframes}")
    return Sightings(landmark, keyframe)


def _cloud_of(tensors: Tensors, voxel_m: float) -> VoxelCloud:
    table, keys = unpack_table(tensors["cloud_blocks"], 5), tensors["cloud_keys"]
    counts, sizes = table[:, 3], table[:, 4]
    _require(bool(np.all(np.abs(table) < 1 << 40)), "a cloud on this planet")
    _require(bool(np.all((counts > 0) & (sizes >= counts))), "cloud blocks that hold voxels")
    _require(bool(np.all(np.diff(table[:, 0]) >= 0)), "cloud blocks sorted by x")
    _require(
        bool(counts.sum() == len(tensors["cloud_means"]) and sizes.sum() == len(keys)),
        "as many voxels as the cloud blocks say",
    )
    starts, key_starts = np.cumsum([0, *counts]), np.cumsum([0, *sizes])
    for first in range(0, len(counts), CHECKED_BLOCKS):
        last = min(first + CHECKED_BLOCKS, len(counts))
        _check_blocks(keys, starts[first : last + 1], key_starts[first : last + 1])
    return VoxelCloud(voxel_m, table[:, :3], starts, key_starts, keys, tensors["cloud_means"])


def _check_blocks(
    keys: np.ndarray, starts: Int64[np.ndarray, "O"], key_starts: Int64[np.ndarray, "O"]
) -> None:
    """Check that some blocks hold the numbers they should, each ending with its block."""
    part = np.asarray(keys[key_starts[0] : key_starts[-1]])
    ends = np.flatnonzero(part < 128)
    last = starts[1:] - 1 - starts[0]
    _require(
        len(ends) == last[-1] + 1
        and bool(np.all(ends[last] == key_starts[1:] - 1 - key_starts[0])),
        "the coded voxels of each cloud block to end with it",
    )
    unpack(part)  # raises where a number is too long

"""A drive with drifting odometry, true loops and false ones, for judging pose-graph back ends."""

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import cKDTree

from sl3d_slam.config import GraphSettings
from sl3d_slam.errors import InputError
from sl3d_slam.geometry.se3 import (
    Transform,
    exp,
    from_yaw,
    invert,
    make_transform,
    nearest_rotation,
)
from sl3d_slam.types import LoopConstraint

Poses = Float64[np.ndarray, "N 4 4"]

# what drifting_odometry does to a step; that it also wanders is for the back end to find out
SETTINGS = GraphSettings(odometry_rotation_sigma_deg=0.04, odometry_translation_sigma_m=0.02)
LOOP_SIGMAS = np.repeat([np.radians(0.2), 0.05], 3)  # rotation first; the noise that loops have
MIN_GAP = 100  # scans between the ends of a loop
LOOP_RADIUS_M = 8.0
STREETS_M = 90.0  # between parallel streets of the built-in drive
CORNERS = "00 40 42 12 10 30 33 03 01 41 44 24 20 00 02 32 31 11 14 04 00 20"  # block x and y


@dataclass(frozen=True, slots=True, eq=False)
class BackendWorld:
    """Truth and measurements of one drive; ``is_true[k]`` tells whether loop k is real.

    The loops come in the order in which a drive would meet them (by query).
    """

    T_world_lidar: Poses
    T_odom_lidar: Poses
    loops: list[LoopConstraint]
    is_true: list[bool]


def built_in_drive(num_poses: int) -> Poses:
    """Return a drive of about 1 m per pose through a grid of hilly streets, with many returns."""
    corners = STREETS_M * np.array([[int(block[0]), int(block[1])] for block in CORNERS.split()])
    legs_m = np.linalg.norm(np.diff(corners, axis=0), axis=1)
    along_m = np.concatenate([[0.0], np.cumsum(legs_m)])
    travel_m = np.arange(num_poses, dtype=np.float64) % along_m[-1]
    xy = np.stack([np.interp(travel_m, along_m, corners[:, axis]) for axis in (0, 1)], axis=1)
    xy = gaussian_filter1d(xy, 4.0, axis=0)
    z = 4.0 * np.sin(xy[:, 0] / 80.0) + 3.0 * np.cos(xy[:, 1] / 60.0)
    position = np.column_stack([xy, z])
    forward = np.gradient(position, axis=0)
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    left = np.cross([0.0, 0.0, 1.0], forward)
    left /= np.linalg.norm(left, axis=1, keepdims=True)
    rotation = np.stack([forward, left, np.cross(forward, left)], axis=2)
    return np.array([make_transform(R, t) for R, t in zip(rotation, position, strict=True)])


def read_kitti_drive(path: Path) -> Poses:
    """Return the poses of a KITTI ground-truth file with x forward and z up.

    Raises InputError where the file is not rows of 12 finite numbers.
    """
    try:
        rows = np.loadtxt(path, ndmin=2)
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: not a KITTI pose file ({error})") from None
    if rows.shape[1] != 12 or len(rows) < 2 or not np.isfinite(rows).all():
        raise InputError(f"{path}: expected rows of 12 finite numbers, one 3x4 pose each")
    R_camera_lidar = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
    T_camera_lidar = make_transform(R_camera_lidar, np.zeros(3))
    T_world_camera = [
        make_transform(nearest_rotation(row[:, :3]), row[:, 3]) for row in rows.reshape(-1, 3, 4)
    ]
    return np.array([invert(T_camera_lidar) @ T @ T_camera_lidar for T in T_world_camera])


def drifting_odometry(T_world_lidar: Poses, rng: np.random.Generator) -> Poses:
    """Return odometry whose steps have white noise and a slowly wandering turn rate.

    0.04 deg and 0.02 m per scan, a turn-rate bias of 0.005 deg per scan that wanders over some 300
    scans, and 0.2 % too long.
    """
    memory = np.exp(-1.0 / 300.0)
    bias = np.radians(0.005) * rng.standard_normal(3)
    poses = [T_world_lidar[0]]
    for before, after in pairwise(T_world_lidar):
        kick = np.radians(0.005) * np.sqrt(1.0 - memory**2) * rng.standard_normal(3)
        bias = memory * bias + kick
        turn = np.radians(0.04) * rng.standard_normal(3) + bias
        T_before_after = invert(before) @ after
        T_before_after[:3, 3] *= 1.002
        noise = exp(np.concatenate([turn, 0.02 * rng.standard_normal(3)]))
        poses.append(poses[-1] @ T_before_after @ noise)
    return np.array(poses)


def true_loops(T_world_lidar: Poses, count: int, rng: np.random.Generator) -> list[LoopConstraint]:
    """Return up to ``count`` loops between poses of the same place, measured with noise.

    Raises InputError where the drive never comes back to a place.
    """
    pairs = cKDTree(T_world_lidar[:, :3, 3]).query_pairs(LOOP_RADIUS_M, output_type="ndarray")
    pairs = np.sort(pairs[np.abs(pairs[:, 0] - pairs[:, 1]) > MIN_GAP], axis=1)
    pairs = pairs[np.lexsort((pairs[:, 0], pairs[:, 1]))]
    if len(pairs) == 0:
        raise InputError(
            f"the drive of {len(T_world_lidar)} poses never comes within {LOOP_RADIUS_M:g} m of a "
            f"place it left {MIN_GAP} poses earlier, so it has no loops to judge a back end by"
        )
    chosen = rng.choice(len(pairs), min(count, len(pairs)), replace=False)
    return [
        _measured(int(a), int(b), invert(T_world_lidar[a]) @ T_world_lidar[b], rng)
        for a, b in pairs[np.sort(chosen)]
    ]


def random_false_loops(
    T_world_lidar: Poses, count: int, rng: np.random.Generator
) -> list[LoopConstraint]:
    """Return loops that take two far places for one, each with its own wrong transform."""
    loops: list[LoopConstraint] = []
    while len(loops) < count:
        first, last = (int(k) for k in np.sort(rng.integers(0, len(T_world_lidar), 2)))
        if last - first > MIN_GAP and _apart_m(T_world_lidar, first, last) > 20.0:
            loops.append(_measured(first, last, _near_miss(rng), rng))
    return loops


def aliased_false_loops(
    T_world_lidar: Poses, count: int, rng: np.random.Generator, group: int = 12
) -> list[LoopConstraint]:
    """Return false loops in groups that agree among themselves: one street taken for another.

    Half of the groups join places within 60 m, where drift could hide the mistake.
    """
    loops: list[LoopConstraint] = []
    span = 3 * group
    while len(loops) < count:
        far_m = 60.0 if rng.random() < 0.5 else np.inf
        first, last = (int(k) for k in np.sort(rng.integers(0, len(T_world_lidar) - span, 2)))
        if last - first < MIN_GAP + span or not 15 < _apart_m(T_world_lidar, first, last) < far_m:
            continue
        T_here_there = T_world_lidar[first] @ _near_miss(rng) @ invert(T_world_lidar[last])
        for k in range(0, 3 * min(group, count - len(loops)), 3):
            T_first_last = invert(T_world_lidar[first + k]) @ T_here_there @ T_world_lidar[last + k]
            loops.append(_measured(first + k, last + k, T_first_last, rng))
    return loops


def make_world(
    T_world_lidar: Poses, num_true: int, share_false: float, kind: str, seed: int
) -> BackendWorld:
    """Return one drive; ``kind`` of its false loops is ``random`` or ``aliased``."""
    rng = np.random.default_rng(seed)
    odometry = drifting_odometry(T_world_lidar, rng)
    good = true_loops(T_world_lidar, num_true, rng)
    num_false = round(len(good) * share_false / (1.0 - share_false))
    make = aliased_false_loops if kind == "aliased" else random_false_loops
    bad = make(T_world_lidar, num_false, rng)
    mixed = sorted(
        [(loop, True) for loop in good] + [(loop, False) for loop in bad],
        key=lambda entry: (entry[0].query_id, entry[0].target_id),
    )
    return BackendWorld(
        T_world_lidar, odometry, [loop for loop, _ in mixed], [is_true for _, is_true in mixed]
    )


def _near_miss(rng: np.random.Generator) -> Transform:
    """Return what a false match looks like: a plausible offset, forwards or backwards."""
    yaw_rad = rng.choice([0.0, np.pi]) + rng.normal(0.0, 0.05)
    return from_yaw(yaw_rad, np.concatenate([rng.normal(0.0, 4.0, 2), rng.normal(0.0, 0.2, 1)]))


def _measured(
    target_id: int, query_id: int, T_target_query: Transform, rng: np.random.Generator
) -> LoopConstraint:
    noisy = T_target_query @ exp(LOOP_SIGMAS * rng.standard_normal(6))
    return LoopConstraint(target_id, query_id, noisy, np.diag(LOOP_SIGMAS**-2.0), 10)


def _apart_m(T_world_lidar: Poses, first: int, last: int) -> float:
    return float(np.linalg.norm(T_world_lidar[first, :3, 3] - T_world_lidar[last, :3, 3]))

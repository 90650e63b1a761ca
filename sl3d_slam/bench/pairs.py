"""Pairs of scans to register: chosen by true distance, or from a public list."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int64

from sl3d_slam.errors import InputError
from sl3d_slam.geometry.se3 import (
    Transform,
    distances_travelled_m,
    invert,
    make_transform,
    nearest_rotation,
)

DISTANCE_TOLERANCE_M = 1.0
DETOUR_FACTOR, DETOUR_M = 1.5, 10.0
LIST_HEADER = "seq i seq_db j mot1 ... mot16"
MAX_LIST_BYTES = 50_000_000

Poses = Float64[np.ndarray, "N 4 4"]
PosesOfAny = Float64[np.ndarray, "_ 4 4"]  # drives of different lengths in one list


@dataclass(frozen=True, slots=True, eq=False)
class ScanPair:
    """Two scans of one or two drives, and how the sensors are turned before they are registered.

    Attributes
    ----------
    source_drive, target_drive : which drive, an index or a sequence number.
    source, target : index of the scan in its drive.
    T_target_source : true pose of the source as it was recorded, in the target; None where the
        scans show different places.
    T_turned_source, T_turned_target : rotations that are applied to the points of each scan first.
    """

    source_drive: int
    source: int
    target_drive: int
    target: int
    T_target_source: Transform | None
    T_turned_source: Transform
    T_turned_target: Transform

    @property
    def truth(self) -> Transform | None:
        """The true pose of the turned source in the turned target."""
        if self.T_target_source is None:
            return None
        return self.T_turned_target @ self.T_target_source @ invert(self.T_turned_source)


def pairs_at_distance(
    poses: Poses, distance_m: float, along_track: bool
) -> Int64[np.ndarray, "P 2"]:
    """Return all (source, target) with source before target whose positions are so far apart.

    Within 1 m of ``distance_m``. ``along_track`` leaves out pairs with much travel between them,
    for poses that drift.
    """
    positions = poses[:, :3, 3]
    travelled_m = distances_travelled_m(positions)
    found = []
    for source in range(len(poses)):
        apart_m = np.linalg.norm(positions[source + 1 :] - positions[source], axis=1)
        fits = np.abs(apart_m - distance_m) <= DISTANCE_TOLERANCE_M
        if along_track:
            longest_m = DETOUR_FACTOR * distance_m + DETOUR_M
            fits &= travelled_m[source + 1 :] - travelled_m[source] <= longest_m
        targets = source + 1 + np.flatnonzero(fits)
        found.append(np.column_stack([np.full(len(targets), source), targets]))
    return np.concatenate(found).astype(np.int64) if found else np.zeros((0, 2), np.int64)


def choose_pairs(
    drives: Sequence[PosesOfAny],
    distance_m: float,
    count: int,
    rng: np.random.Generator,
    along_track: bool,
) -> list[tuple[int, int, int]]:
    """Return up to ``count`` (drive, source, target), as evenly from the drives as they allow.

    Which of the two scans is the source is drawn too.
    """
    pools = []
    for drive, poses in enumerate(drives):
        pool = pairs_at_distance(poses, distance_m, along_track)
        pool = np.where(rng.random((len(pool), 1)) < 0.5, pool, pool[:, ::-1])
        pools.append([(drive, int(a), int(b)) for a, b in rng.permutation(pool)])
    chosen: list[tuple[int, int, int]] = []
    while len(chosen) < count and any(pools):
        chosen += [pool.pop() for pool in pools if pool][: count - len(chosen)]
    return chosen


def random_turn(rng: np.random.Generator, yaw: bool, tilt_deg: float) -> Transform:
    """Return a rotation by any yaw, then roll and pitch each up to ``tilt_deg`` either way."""
    turn = np.eye(4)
    angles = rng.uniform(-1.0, 1.0, 3) * [np.pi if yaw else 0.0, *[np.radians(tilt_deg)] * 2]
    for angle, axis in zip(angles, (2, 1, 0), strict=True):
        c, s = np.cos(angle), np.sin(angle)
        rotation = np.eye(3)
        first, second = (axis + 1) % 3, (axis + 2) % 3
        rotation[[first, second], [first, second]] = c
        rotation[first, second], rotation[second, first] = -s, s
        turn = make_transform(rotation, np.zeros(3)) @ turn
    return turn


def read_pair_list(path: Path) -> list[tuple[int, int, int, int, Transform]]:
    """Read a public list of pairs: (sequence, scan, sequence, scan, T_target_source).

    The format of the LiDAR registration benchmark (test splits ``kitti_10m`` and ``kitti_lc``): a
    heading, then ``seq i seq_db j mot1 ... mot16`` a row. ``mot`` is row-major and takes points of
    scan i to the frame of scan j, both in the **lidar** frame: so i is the source and j the target.
    (Compared with SemanticKITTI's true poses moved to the lidar frame: medians of 0.05 to 0.14 m
    and 0.15 to 0.5 deg in that direction, 12 m and more in the other or in the camera frame.)

    Raises
    ------
    InputError
        naming the file and the line that is malformed.
    """
    try:
        if path.stat().st_size > MAX_LIST_BYTES:
            raise InputError(f"{path}: larger than {MAX_LIST_BYTES} bytes, not a list of pairs")
        lines = path.read_text(encoding="utf-8").splitlines()
    except OSError as error:
        raise InputError(f"{path}: cannot be read as a list of pairs ({error.strerror})") from None
    except UnicodeDecodeError:
        raise InputError(f"{path}: not a text file; expected {LIST_HEADER}") from None
    if not lines or re.split(r"[\s,]+", lines[0].strip())[:4] != ["seq", "i", "seq_db", "j"]:
        raise InputError(f"{path}: line 1 is not the heading '{LIST_HEADER}'")
    pairs = [_parse(path, number, line) for number, line in enumerate(lines[1:], 2) if line.strip()]
    if not pairs:
        raise InputError(f"{path}: a heading but no pairs")
    return pairs


def _parse(path: Path, number: int, line: str) -> tuple[int, int, int, int, Transform]:
    words = re.split(r"[\s,]+", line.strip())
    expected = f"{path}: line {number}: expected {LIST_HEADER}, 20 numbers"
    if len(words) != 20:
        raise InputError(f"{expected}; found {len(words)}")
    try:
        indices = [int(word) for word in words[:4]]
        matrix = np.array([float(word) for word in words[4:]]).reshape(4, 4)
    except ValueError:
        raise InputError(f"{expected}; found one that is none") from None
    if min(indices) < 0:
        raise InputError(f"{path}: line {number}: a scan or sequence number is negative")
    if not np.isfinite(matrix).all() or np.abs(matrix[3] - [0, 0, 0, 1]).max() > 1e-6:
        raise InputError(f"{path}: line {number}: the last row of the 4x4 is not 0 0 0 1")
    rotation = nearest_rotation(matrix[:3, :3])
    if np.abs(rotation - matrix[:3, :3]).max() > 0.01:
        raise InputError(f"{path}: line {number}: the 4x4 is not a rigid transform")
    source_sequence, source, target_sequence, target = indices
    T_target_source = make_transform(rotation, matrix[:3, 3])
    return source_sequence, source, target_sequence, target, T_target_source

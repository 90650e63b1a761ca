"""Single scan files (.bin, .pcd, .ply) and the natural order of a folder of them."""

import re
from pathlib import Path

import numpy as np

from sl3d_slam.errors import InputError
from sl3d_slam.files import no_file
from sl3d_slam.geometry.se3 import Points

MAX_SCAN_BYTES = 1024**3
KITTI_POINT_BYTES = 16


def natural_key(path: Path) -> tuple[tuple[int, int, str], ...]:
    """Sort key by which ``scan2`` comes before ``scan10``; ties go by the name itself."""
    parts = re.findall(r"[0-9]+|[^0-9]+", path.name)
    key = [(0, int(p), p) if p[0] in "0123456789" else (1, 0, p) for p in parts]
    return tuple(key)


def list_scans(folder: Path, suffixes: tuple[str, ...]) -> list[Path]:
    """Return the scan files of a folder in natural order. Raises InputError."""
    kinds = ", ".join(f"*{suffix}" for suffix in suffixes)
    try:
        found = [p for p in folder.iterdir() if p.suffix.lower() in suffixes and p.name[0] != "."]
    except OSError as error:
        raise InputError(f"{folder}: cannot be listed ({error.strerror})") from None
    if not found:
        raise InputError(f"{folder}: holds no scans; expected {kinds}")
    if len({p.suffix.lower() for p in found}) > 1:
        raise InputError(f"{folder}: holds scans of several kinds; expected only one of {kinds}")
    return sorted(found, key=natural_key)


def read_bytes(path: Path, expected: str) -> bytes:
    """Return the content of a regular, non-empty file of bounded size. Raises InputError."""
    try:
        if not path.is_file():
            raise InputError(f"{path}: {no_file(path)}; expected {expected}")
        size = path.stat().st_size
        if size == 0:
            raise InputError(f"{path}: is empty; expected {expected}")
        if size > MAX_SCAN_BYTES:
            raise InputError(f"{path}: {size} bytes is too large for one scan; expected {expected}")
        return path.read_bytes()
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror}); expected {expected}"
        ) from None


def read_bin(path: Path) -> Points:
    """Return the (N, 3) metres of a KITTI file of float32 ``x y z intensity``, unfiltered.

    Raises
    ------
    InputError
        naming a file that is missing, empty or not a whole number of 16-byte points.
    """
    raw = read_bytes(path, "a KITTI scan of 16-byte points (float32 x y z intensity)")
    if len(raw) % KITTI_POINT_BYTES:
        raise InputError(
            f"{path}: {len(raw)} bytes is not a whole number of 16-byte points; "
            "expected a KITTI scan (float32 x y z intensity)"
        )
    return np.frombuffer(raw, dtype="<f4").reshape(-1, 4)[:, :3].astype(np.float64)

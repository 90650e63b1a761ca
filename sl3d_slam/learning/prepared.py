"""Scans as training wants them, and a file that keeps a whole drive of them."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64, Int32, UInt8
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from sl3d_slam.errors import InputError
from sl3d_slam.files import write_whole

BACKGROUND, IGNORED = -1, -2
COLUMNS = ("points", "line_ids", "endpoints", "kinds")


@dataclass(frozen=True, slots=True, eq=False)
class PreparedScan:
    """What the network sees of a scan, and what is true of it; lidar frame, metres.

    Attributes
    ----------
    points : (M, 4) as :func:`sl3d_slam.lines.network.sample.network_points` gives them: x, y, z
        and the height above the ground.
    line_ids : (M,) row of ``endpoints`` that a point belongs to, -1 background, -2 not known.
    endpoints : (L, 2, 3) the labelled lines; their rows count for this scan alone.
    kinds : (L,) values of :class:`sl3d_slam.types.LineKind`.
    """

    points: Float32[np.ndarray, "M 4"]
    line_ids: Int32[np.ndarray, "M"]
    endpoints: Float32[np.ndarray, "L 2 3"]
    kinds: UInt8[np.ndarray, "L"]


@dataclass(frozen=True, slots=True, eq=False)
class PreparedDrive:
    """The prepared scans of one drive with ``T_world_lidar`` (N, 4, 4) of each."""

    name: str
    simulated: bool
    T_world_lidar: Float64[np.ndarray, "N 4 4"]
    scans: tuple[PreparedScan, ...]


def save_drive(path: Path, drive: PreparedDrive, key: str) -> None:
    """Write a drive whole; ``key`` says what it was made of."""
    tensors = {"T_world_lidar": drive.T_world_lidar}
    for name in COLUMNS:
        parts = [getattr(scan, name) for scan in drive.scans]
        tensors[name] = np.ascontiguousarray(np.concatenate(parts))
        tensors[f"{name}_starts"] = np.cumsum([0, *map(len, parts)]).astype(np.int64)
    about = {"name": drive.name, "simulated": drive.simulated, "key": key}
    write_whole(path, save(tensors, {"about": json.dumps(about)}))


def load_drive(path: Path, key: str) -> PreparedDrive | None:
    """Return the drive kept at a path, or None where there is none made of the same things.

    Raises
    ------
    InputError
        naming a file that is damaged.
    """
    if not path.is_file():
        return None
    try:
        with safe_open(path, framework="numpy") as file:
            about = json.loads(file.metadata()["about"])
            if about["key"] != key:
                return None
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        scans = _scans_of([_parts(tensors, name) for name in COLUMNS])
        return PreparedDrive(about["name"], about["simulated"], tensors["T_world_lidar"], scans)
    except (SafetensorError, KeyError, TypeError, ValueError, OSError):
        raise InputError(
            f"{path}: damaged; expected a drive prepared for training; delete it to prepare anew"
        ) from None


def _parts(tensors: dict[str, np.ndarray], name: str) -> list[np.ndarray]:
    return np.split(tensors[name], tensors[f"{name}_starts"][1:-1])


def _scans_of(columns: Sequence[list[np.ndarray]]) -> tuple[PreparedScan, ...]:
    return tuple(PreparedScan(*parts) for parts in zip(*columns, strict=True))

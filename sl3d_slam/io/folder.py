"""Folders of scan files, read one at a time in natural order."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from sl3d_slam.config import InputSettings
from sl3d_slam.errors import InputError
from sl3d_slam.io.dataset import Dataset
from sl3d_slam.io.pcd import read_pcd
from sl3d_slam.io.ply import read_ply
from sl3d_slam.io.points import Cloud, corrected, make_scan
from sl3d_slam.io.scan_file import list_scans, read_bin
from sl3d_slam.io.stamps import read_stamps
from sl3d_slam.types import Scan

SUFFIXES = (".bin", ".pcd", ".ply")


def read_cloud(path: Path) -> Cloud:
    """Return what a ``.bin``, ``.pcd`` or ``.ply`` file holds, unfiltered. Raises InputError."""
    match path.suffix.lower():
        case ".bin":
            return Cloud(read_bin(path))
        case ".pcd":
            return read_pcd(path)
        case ".ply":
            return read_ply(path)
    raise InputError(f"{path}: unknown kind of scan; expected {', '.join(SUFFIXES)}")


@dataclass(frozen=True, slots=True, eq=False)
class ScanFiles:
    """Streams scan files; ``files`` and ``stamps_s`` have one entry a scan."""

    files: tuple[Path, ...]
    stamps_s: Float64[np.ndarray, "N"]
    elevation_offset_deg: float
    settings: InputSettings

    def __call__(self, start: int, stop: int) -> Iterator[Scan]:
        """Read the scans with start <= index < stop, each when it is asked for."""
        for index in range(start, stop):
            cloud = corrected(read_cloud(self.files[index]), self.elevation_offset_deg)
            position = (index, float(self.stamps_s[index]))
            yield make_scan(position, cloud, self.settings, str(self.files[index]))


def open_folder(path: Path, elevation_offset_deg: float, settings: InputSettings) -> Dataset:
    """Open a folder of ``.bin``, ``.pcd`` or ``.ply`` scans, with ``times.txt`` where it has one.

    Raises
    ------
    InputError
        naming the folder where it has no scans, or more than one kind.
    """
    files = tuple(list_scans(path, SUFFIXES))
    stamps_s, warnings = read_stamps(path / "times.txt", files)
    return Dataset(
        name=path.resolve().name,
        description=f"folder {path} ({len(files)} {files[0].suffix} scans)",
        num_scans=len(files),
        read_scans=ScanFiles(files, stamps_s, elevation_offset_deg, settings),
        warnings=warnings,
    )

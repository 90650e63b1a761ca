"""KITTI odometry layout: ``sequences/SS/{velodyne,calib.txt,times.txt}`` and ``poses/SS.txt``."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from sl3d_slam.config import InputSettings
from sl3d_slam.errors import InputError
from sl3d_slam.geometry.se3 import Transform, make_transform, nearest_rotation
from sl3d_slam.io.dataset import Dataset
from sl3d_slam.io.points import KITTI_ELEVATION_OFFSET_DEG, make_scan, raise_elevation
from sl3d_slam.io.scan_file import list_scans, read_bin
from sl3d_slam.io.text_table import read_table, read_text
from sl3d_slam.io.trajectory import read_kitti_poses, to_lidar_frame
from sl3d_slam.types import Scan

SCANS_FOLDER = "velodyne"
SIMULATION_FILE = "simulation.json"
ASSUMED_RATE_HZ = 10.0
_CALIB_KEYS = ("Tr:", "Tr_velo_to_cam:", "Tr_velo_cam:")


def is_kitti(path: Path) -> bool:
    """Tell whether a folder is a KITTI root, its ``sequences`` folder, or one sequence."""
    return (
        (path / SCANS_FOLDER).is_dir()
        or (path / "sequences").is_dir()
        or (path.name == SCANS_FOLDER and (path.parent / "calib.txt").is_file())
    )


def open_kitti(path: Path, sequence: str | None, settings: InputSettings) -> Dataset:
    """Open one sequence; truth is converted to the lidar frame where poses are present.

    ``path`` is the root of the dataset (then ``sequence`` says which, unless there is only one) or
    the folder of a sequence.

    Raises
    ------
    InputError
        naming the folder or file that is missing or damaged.
    """
    folder = find_sequence(path, sequence)
    scans = list_scans(folder / SCANS_FOLDER, (".bin",))
    T_cam_lidar = read_calib(folder / "calib.txt")
    stamps_s, warnings = _read_stamps(folder / "times.txt", scans)
    simulated = (folder / SIMULATION_FILE).is_file()
    corrected = corrects(folder, settings)
    poses_file = _find_poses(folder)
    truth = None
    if poses_file is not None:
        camera_poses = read_kitti_poses(poses_file)
        truth = to_lidar_frame(_pick_rows(camera_poses, scans, poses_file), T_cam_lidar)
    correction = f"elevation raised by {KITTI_ELEVATION_OFFSET_DEG} deg" if corrected else "as is"
    return Dataset(
        name=folder.name,
        description=f"KITTI sequence {folder} ({len(scans)} scans, {correction})",
        num_scans=len(scans),
        read_scans=_KittiScans(tuple(scans), stamps_s, corrected, settings),
        truth=truth,
        T_cam_lidar=T_cam_lidar,
        simulated=simulated,
        warnings=warnings,
    )


@dataclass(frozen=True, slots=True, eq=False)
class _KittiScans:
    files: tuple[Path, ...]
    stamps_s: Float64[np.ndarray, "N"]
    corrected: bool
    settings: InputSettings

    def __call__(self, start: int, stop: int) -> Iterator[Scan]:
        for index in range(start, stop):
            points = read_bin(self.files[index])
            if self.corrected:
                points = raise_elevation(points, KITTI_ELEVATION_OFFSET_DEG)
            position = (index, float(self.stamps_s[index]))
            yield make_scan(position, points, None, self.settings, str(self.files[index]))


def find_sequence(path: Path, sequence: str | None) -> Path:
    """Return the folder of the wanted sequence, or raise InputError listing what there is."""
    if path.name == SCANS_FOLDER and not (path / SCANS_FOLDER).is_dir():
        path = path.parent
    if (path / SCANS_FOLDER).is_dir():
        if sequence is not None and sequence.zfill(2) != path.name:
            raise InputError(f"{path}: is one sequence; expected a dataset that has {sequence!r}")
        return path
    root = path / "sequences"
    names = sorted(p.name for p in root.glob("*") if (p / SCANS_FOLDER).is_dir())
    if not names:
        raise InputError(f"{path}: no KITTI sequence; expected sequences/SS/{SCANS_FOLDER}/*.bin")
    if sequence is None:
        if len(names) > 1:
            raise InputError(
                f"{path}: has sequences {', '.join(names)}; choose one with --sequence"
            )
        return root / names[0]
    wanted = sequence if sequence in names else sequence.zfill(2)
    if wanted not in names:
        raise InputError(f"{path}: no sequence {sequence!r}; it has {', '.join(names)}")
    return root / wanted


def corrects(folder: Path, settings: InputSettings) -> bool:
    """Tell whether scans of a KITTI sequence get the HDL-64E elevation correction."""
    if settings.kitti_correction == "auto":
        return not (folder / SIMULATION_FILE).is_file()
    return settings.kitti_correction == "on"


def read_calib(path: Path) -> Transform:
    """Return ``T_cam_lidar``, the line ``Tr:`` of a KITTI ``calib.txt``. Raises InputError."""
    expected = "a KITTI calib.txt with a line 'Tr:' of 12 numbers, lidar to camera"
    for line in read_text(path, expected).splitlines():
        if not line.startswith(_CALIB_KEYS):
            continue
        try:
            values = np.array([float(word) for word in line.split()[1:]])
        except ValueError:
            break
        if values.size != 12 or not np.isfinite(values).all():
            break
        matrix = values.reshape(3, 4)
        rotation = nearest_rotation(matrix[:, :3])
        if np.abs(rotation - matrix[:, :3]).max() > 0.01:
            break
        return make_transform(rotation, matrix[:, 3])
    raise InputError(f"{path}: no rigid transform found; expected {expected}")


def _read_stamps(path: Path, scans: list[Path]) -> tuple[np.ndarray, tuple[str, ...]]:
    if not path.exists():
        warning = f"{path}: not found; the scans are taken to be {ASSUMED_RATE_HZ:g} a second"
        return np.arange(len(scans)) / ASSUMED_RATE_HZ, (warning,)
    stamps_s = read_table(path, 1, "one time in seconds a line")
    picked = _pick_rows(stamps_s, scans, path)[:, 0]
    if np.any(np.diff(picked) <= 0):
        raise InputError(f"{path}: times do not increase; expected one time in seconds a line")
    return picked, ()


def _find_poses(folder: Path) -> Path | None:
    candidates = (folder.parent.parent / "poses" / f"{folder.name}.txt", folder / "poses.txt")
    return next((path for path in candidates if path.is_file()), None)


def _pick_rows(rows: np.ndarray, scans: list[Path], source: Path) -> np.ndarray:
    """Return one row a scan; where the counts differ, a scan's number is its row.

    So a part of a sequence works with the files of the whole.
    """
    if len(rows) == len(scans):
        return rows
    numbers = [int(scan.stem) if scan.stem.isdecimal() else -1 for scan in scans]
    if min(numbers) < 0 or max(numbers) >= len(rows):
        raise InputError(
            f"{source}: has {len(rows)} rows for {len(scans)} scans; expected one each"
        )
    return rows[numbers]

"""KITTI odometry layout: ``sequences/SS/{velodyne,calib.txt,times.txt}`` and ``poses/SS.txt``."""

from pathlib import Path

import numpy as np

from sl3d_slam.config import InputSettings
from sl3d_slam.errors import InputError
from sl3d_slam.geometry.se3 import Points, Transform, make_transform, nearest_rotation
from sl3d_slam.io.dataset import Dataset
from sl3d_slam.io.folder import ScanFiles, read_cloud
from sl3d_slam.io.points import elevation_offset_deg, looks_like_hdl64
from sl3d_slam.io.scan_file import list_scans
from sl3d_slam.io.stamps import pick_rows, read_stamps
from sl3d_slam.io.text_table import read_text
from sl3d_slam.io.trajectory import read_kitti_poses, to_lidar_frame

SCANS_FOLDER = "velodyne"
SIMULATION_FILE = "simulation.json"
_CALIB_KEYS = ("Tr:", "Tr_velo_to_cam:", "Tr_velo_cam:")


def is_kitti(path: Path) -> bool:
    """Tell whether a folder is a KITTI root, its ``sequences`` folder, or one sequence."""
    return (
        (path / SCANS_FOLDER).is_dir()
        or (path.name == SCANS_FOLDER and (path.parent / "calib.txt").is_file())
        or bool(_sequence_names(_sequences(path)))
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
    scans = tuple(list_scans(folder / SCANS_FOLDER, (".bin",)))
    T_cam_lidar = read_calib(folder / "calib.txt")
    stamps_s, warnings = read_stamps(folder / "times.txt", scans)
    offset_deg = elevation_offset_deg(
        settings, lambda: is_real_hdl64(folder, read_cloud(scans[0]).points)
    )
    poses_file = _find_poses(folder)
    truth = None
    if poses_file is not None:
        camera_poses = pick_rows(read_kitti_poses(poses_file), scans, poses_file)
        truth = to_lidar_frame(camera_poses, T_cam_lidar)
    return Dataset(
        name=folder.name,
        description=(
            f"KITTI sequence {folder} ({len(scans)} scans, elevation raised by {offset_deg:g} deg)"
        ),
        num_scans=len(scans),
        read_scans=ScanFiles(scans, stamps_s, offset_deg, settings),
        truth=truth,
        T_cam_lidar=T_cam_lidar,
        simulated=(folder / SIMULATION_FILE).is_file(),
        warnings=warnings,
    )


def find_sequence(path: Path, sequence: str | None) -> Path:
    """Return the folder of the wanted sequence, or raise InputError listing what there is."""
    if path.name == SCANS_FOLDER and not (path / SCANS_FOLDER).is_dir():
        path = path.parent
    if (path / SCANS_FOLDER).is_dir():
        if sequence is not None and sequence.zfill(2) != path.name:
            raise InputError(f"{path}: is one sequence; expected a dataset that has {sequence!r}")
        return path
    root = _sequences(path)
    names = _sequence_names(root)
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


def _sequences(path: Path) -> Path:
    inner = path / "sequences"
    return inner if inner.is_dir() else path


def _sequence_names(root: Path) -> list[str]:
    return sorted(p.name for p in root.glob("*") if (p / SCANS_FOLDER).is_dir())


def is_real_hdl64(sequence: Path, points: Points) -> bool:
    """Tell whether a scan of a sequence is one of KITTI's Velodyne HDL-64E.

    It is not where the folder holds ``simulation.json``, nor where the field of view is another.
    """
    return not (sequence / SIMULATION_FILE).is_file() and looks_like_hdl64(points)


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


def _find_poses(folder: Path) -> Path | None:
    candidates = (folder.parent.parent / "poses" / f"{folder.name}.txt", folder / "poses.txt")
    return next((path for path in candidates if path.is_file()), None)

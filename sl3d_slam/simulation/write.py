"""A simulated drive as a KITTI odometry sequence, with truth beside it."""

import json
import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sl3d_slam.errors import OutputError
from sl3d_slam.geometry.se3 import invert
from sl3d_slam.simulation.drive import Drive, simulate_drive
from sl3d_slam.simulation.roads import TR_CAMERA_LIDAR
from sl3d_slam.simulation.scene import SimulatedScan

FORMAT_VERSION = 1
SCAN_PERIOD_S = 0.1
CAMERA = "7.188560e+02 0 6.071928e+02 0 0 7.188560e+02 1.852157e+02 0 0 0 1 0"


@dataclass(frozen=True, slots=True)
class Layout:
    """Where a sequence goes."""

    root: Path
    sequence: str = "00"
    truth: bool = True

    @property
    def folder(self) -> Path:
        """The folder of the sequence."""
        return self.root / "sequences" / self.sequence

    @property
    def poses(self) -> Path:
        """The file with the true poses of the camera."""
        return self.root / "poses" / f"{self.sequence}.txt"


def write_drive(drive: Drive, layout: Layout, progress: Callable[[], None] = lambda: None) -> Path:
    """Simulate a drive and write it; return the folder of the sequence.

    ``sequences/SS/`` gets ``velodyne/NNNNNN.bin``, ``times.txt``, ``calib.txt``,
    ``simulation.json`` (its presence marks the data as simulated), ``T_world_lidar.txt`` (12
    numbers a row) and, with truth, ``lines.npz`` (endpoints, kinds, semantics in the world frame)
    and ``labels/NNNNNN.npz`` (semantic, line_id of each point). ``poses/SS.txt`` holds the camera
    poses. World is the town frame: the lidar at scan 0 of day 0, for drives of every day. The
    sequence appears when it is complete; ``progress`` is called after each scan.

    Raises
    ------
    OutputError
        where the sequence is already there or cannot be written.
    """
    refuse_existing(layout)
    partial = layout.folder.with_name(layout.folder.name + ".partial")
    try:
        shutil.rmtree(partial, ignore_errors=True)
        (partial / "velodyne").mkdir(parents=True)
        if layout.truth:
            (partial / "labels").mkdir()
        for index, scan in enumerate(simulate_drive(drive)):
            _write_scan(partial, index, scan, layout.truth)
            progress()
        _write_sequence(partial, drive, layout.truth)
        _write_poses(layout.poses, drive)
        if layout.folder.is_dir():
            layout.folder.rmdir()
        os.replace(partial, layout.folder)
    except OSError as error:
        raise OutputError(f"{layout.folder}: cannot be written ({error.strerror})") from None
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return layout.folder


def refuse_existing(layout: Layout) -> None:
    """Raise where a sequence would be overwritten or its name leads out of the folder."""
    if not layout.sequence.isalnum():
        raise OutputError(f"sequence {layout.sequence!r}: expected letters and digits, such as 00")
    if layout.folder.exists() and not (layout.folder.is_dir() and not any(layout.folder.iterdir())):
        raise OutputError(f"{layout.folder}: already there; name another folder or --sequence")


def _write_scan(folder: Path, index: int, scan: SimulatedScan, truth: bool) -> None:
    rows = np.column_stack([scan.points_lidar, scan.intensities]).astype("<f4")
    rows.tofile(folder / "velodyne" / f"{index:06d}.bin")
    if truth:
        np.savez_compressed(
            folder / "labels" / f"{index:06d}.npz",
            semantic=scan.labels,
            line_id=scan.line_ids.astype(np.int32),
        )


def _write_sequence(folder: Path, drive: Drive, truth: bool) -> None:
    poses = drive.T_town_lidar[:, :3].reshape(-1, 12)
    np.savetxt(folder / "T_world_lidar.txt", poses, fmt="%.9f")
    np.savetxt(folder / "times.txt", SCAN_PERIOD_S * np.arange(len(drive)), fmt="%.6e")
    numbers = " ".join(f"{value:.12e}" for value in TR_CAMERA_LIDAR[:3].ravel())
    cameras = "".join(f"P{k}: {CAMERA}\n" for k in range(4))
    (folder / "calib.txt").write_text(f"{cameras}Tr: {numbers}\n", encoding="utf-8")
    about = {
        "simulated": True,
        "version": FORMAT_VERSION,
        "road": drive.town.road.name,
        "seed": drive.town.seed,
        "day": drive.day,
        "direction": drive.direction,
        "sensor": drive.sensor.name,
        "scans": len(drive),
        "world_frame": "the lidar at scan 0 of day 0, driven forward",
    }
    (folder / "simulation.json").write_text(json.dumps(about, indent=2) + "\n", encoding="utf-8")
    if truth:
        lines = drive.town.lines
        np.savez_compressed(
            folder / "lines.npz",
            endpoints=lines.endpoints,
            kinds=lines.kinds,
            semantics=lines.semantics,
        )


def _write_poses(path: Path, drive: Drive) -> None:
    """Write ``T_camera0_camera`` of day 0's first camera, 12 numbers a row."""
    T_lidar_camera = invert(TR_CAMERA_LIDAR)
    poses = TR_CAMERA_LIDAR @ drive.T_town_lidar @ T_lidar_camera
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(path.name + ".partial")
    np.savetxt(partial, poses[:, :3].reshape(-1, 12), fmt="%.9e")
    os.replace(partial, path)

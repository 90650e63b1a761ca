"""Drives made ready for training: network points, poses, and labels from where they can be had."""

import hashlib
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64

from sl3d_slam.config import InputSettings, LineSettings, OdometrySettings
from sl3d_slam.errors import InputError
from sl3d_slam.files import prepare_run_folder
from sl3d_slam.geometry.se3 import Points
from sl3d_slam.io.dataset import Dataset
from sl3d_slam.io.folder import ScanFiles, read_cloud
from sl3d_slam.io.open import open_dataset
from sl3d_slam.io.points import corrected, usable
from sl3d_slam.learning.landmarks import Landmarks, find_landmarks, label_points
from sl3d_slam.learning.prepared import (
    PreparedDrive,
    PreparedScan,
    load_drive,
    save_drive,
)
from sl3d_slam.learning.scan_labels import (
    kept_lines,
    network_labels,
    read_labels,
    read_town,
    town_scan,
)
from sl3d_slam.lines.extract import LineExtractor
from sl3d_slam.lines.network.sample import network_points
from sl3d_slam.lines.network.settings import NetworkSettings
from sl3d_slam.lines.scene import make_scene
from sl3d_slam.odometry.odometry import Odometry

FORMAT = 4
Progress = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class DriveSource:
    """Where a drive lies, and its labels where they were made before (``NNNNNN.npz``)."""

    folder: Path
    labels: Path | None = None


def find_sources(data: Sequence[Path], labels: Sequence[Path]) -> list[DriveSource]:
    """Return every drive below the given paths, each with its labels where a folder has them.

    Labels beside the scans come first. ``labels`` are folders that hold ``NAME/labels`` of a drive
    (or its last round, ``NAME/round3/labels``); where a single drive is meant NAME may be left out.
    """
    found = []
    for path in data:
        inner = sorted(p.parent for p in path.glob("sequences/*/velodyne"))
        found += inner or [path]
    return [DriveSource(folder, _labels_of(folder, labels)) for folder in found]


def _labels_of(folder: Path, labels: Sequence[Path]) -> Path | None:
    named = [base / folder.name for base in labels]
    places = [folder / "labels"]
    for base in [*named, *labels]:
        places += [base / "labels", *sorted(base.glob("round*/labels"), reverse=True), base]
    return next((place for place in places if any(place.glob("[0-9]*.npz"))), None)


def prepare_drive(
    source: DriveSource,
    cache: Path,
    network: NetworkSettings,
    progress: Progress = lambda _: None,
) -> PreparedDrive:
    """Return a drive ready for training, from ``cache`` where it was prepared before.

    Poses are the true ones of a simulated drive; any other gets odometry, as satellite poses are
    off by more than lines may be. Labels come from files where there are some, else from
    landmarks: see :mod:`sl3d_slam.learning.landmarks`.

    Raises
    ------
    InputError
        naming the folder or file that cannot be used.
    """
    key = _key(source, network)
    name = f"{source.folder.name}-{hashlib.sha256(key.encode()).hexdigest()[:12]}.safetensors"
    kept = load_drive(cache / name, key)
    if kept is not None:
        return kept
    dataset = open_dataset(source.folder, InputSettings())
    T_world_lidar = poses_of(dataset)
    if source.labels is None:
        scans = _scans_by_landmarks(dataset, T_world_lidar, network, progress)
    else:
        labelled = [k for k in range(len(dataset)) if _label_file(source.labels, k).is_file()]
        T_world_lidar = T_world_lidar[labelled]
        plan = _LabelledScans(source, tuple(labelled), T_world_lidar)
        scans = _scans_by_files(dataset, plan, network, progress)
    drive = PreparedDrive(dataset.name, dataset.simulated, T_world_lidar, tuple(scans))
    prepare_run_folder(cache)
    save_drive(cache / name, drive, key)
    return drive


def _key(source: DriveSource, network: NetworkSettings) -> str:
    fields = network.model_dump(include={"voxel_size_m", "max_points"})
    labels = None if source.labels is None else str(source.labels.resolve())
    files = [] if source.labels is None else sorted(source.labels.glob("*.npz"))
    newest = max((file.stat().st_mtime_ns for file in files), default=0)
    return json.dumps([FORMAT, str(source.folder.resolve()), labels, len(files), newest, fields])


def poses_of(dataset: Dataset) -> Float64[np.ndarray, "N 4 4"]:
    """Return the true poses of a simulated drive, of a real one this package's odometry."""
    if dataset.simulated and dataset.truth is not None:
        return dataset.truth
    odometry = Odometry(OdometrySettings(), InputSettings())
    return np.array([odometry.register(scan).T_odom_lidar for scan in dataset])


def _scans_by_landmarks(
    dataset: Dataset, T_world_lidar: np.ndarray, network: NetworkSettings, progress: Progress
) -> Iterator[PreparedScan]:
    clouds, found = [], []
    extractor = LineExtractor(LineSettings(method="geometric"))
    for scan in dataset:
        clouds.append(points_of_network(scan.points_lidar, network))
        found.append(extractor.extract(scan.points_lidar))
        progress(dataset.name)
    landmarks = find_landmarks(found, T_world_lidar)
    for points, T in zip(clouds, T_world_lidar, strict=True):
        yield _labelled(points, landmarks, T, T_world_lidar[:, :3, 3])


def points_of_network(points_lidar: Points, network: NetworkSettings) -> Float32[np.ndarray, "M 4"]:
    """Return what the network sees of a scan, in the lidar frame."""
    scene = make_scene(points_lidar, LineSettings())
    points = network_points(scene, network)
    points[:, :3] = points[:, :3] @ scene.R_level_lidar.astype(np.float32)
    return points


def _labelled(
    points: np.ndarray, landmarks: Landmarks, T_world_lidar: np.ndarray, places: np.ndarray
) -> PreparedScan:
    ids, endpoints, kinds = label_points(points[:, :3], landmarks, T_world_lidar, places)
    return PreparedScan(points, ids, endpoints.astype(np.float32), kinds)


@dataclass(frozen=True, slots=True, eq=False)
class _LabelledScans:
    """The scans of a drive that have labels, and their poses."""

    source: DriveSource
    indices: tuple[int, ...]
    T_world_lidar: Float64[np.ndarray, "N 4 4"]


def _label_file(folder: Path, index: int) -> Path:
    return folder / f"{index:06d}.npz"


def _scans_by_files(
    dataset: Dataset, plan: _LabelledScans, network: NetworkSettings, progress: Progress
) -> Iterator[PreparedScan]:
    files, folder, labels = dataset.read_scans, plan.source.folder, plan.source.labels
    if not isinstance(files, ScanFiles) or labels is None:
        raise InputError(f"{folder}: labels go with scan files, not with a bag")
    town = read_town(folder / "lines.npz") if dataset.simulated else None
    for index, T_world_lidar in zip(plan.indices, plan.T_world_lidar, strict=True):
        path = files.files[index]
        cloud = corrected(read_cloud(path), files.elevation_offset_deg)
        keep = usable(cloud.points, files.settings, str(path))
        line_ids, endpoints = read_labels(_label_file(labels, index), len(keep))
        raw = cloud.points[keep]
        points = points_of_network(raw, network)
        ids = network_labels(points[:, :3], raw, line_ids[keep])
        if town is None:
            yield kept_lines(points, ids, endpoints, np.zeros(len(endpoints), np.uint8))
        else:
            yield town_scan(points, ids, town, T_world_lidar)
        progress(dataset.name)

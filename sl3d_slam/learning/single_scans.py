"""Scans of unrelated places made ready for training: a network or geometry tells their lines."""

import hashlib
import json
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from sl3d_slam.config import InputSettings, LineSettings
from sl3d_slam.files import prepare_run_folder
from sl3d_slam.io.open import open_dataset
from sl3d_slam.learning.landmarks import Landmarks, label_points
from sl3d_slam.learning.prepare import FORMAT, Progress, points_of_network
from sl3d_slam.learning.prepared import PreparedDrive, PreparedScan, load_drive, save_drive
from sl3d_slam.lines.extract import LineExtractor
from sl3d_slam.lines.network.settings import NetworkSettings
from sl3d_slam.types import LineSet

SURE_LINES, ALL_LINES = 40, 120
APART_M = 1000.0


def prepare_singles(
    folder: Path,
    cache: Path,
    network: NetworkSettings,
    weights: Path | None,
    progress: Progress = lambda _: None,
) -> PreparedDrive:
    """Return scans of places that have nothing to do with each other, ready for training.

    The 40 best lines of a scan are taken for true, by the network of ``weights`` or by geometry
    where there is none; points on less certain ones are not known. From ``cache`` where that was
    done before.

    Raises
    ------
    InputError
        naming the folder or file that cannot be used.
    """
    extractor = _extractor(weights)
    fields = network.model_dump(include={"voxel_size_m", "max_points"})
    key = json.dumps([FORMAT, "singles", str(folder.resolve()), extractor.model, fields])
    file = cache / f"singles-{hashlib.sha256(key.encode()).hexdigest()[:12]}.safetensors"
    kept = load_drive(file, key)
    if kept is not None:
        return kept
    dataset = open_dataset(folder, InputSettings())
    scans = []
    for scan in dataset:
        points = points_of_network(scan.points_lidar, network)
        scans.append(_labelled(points, extractor.extract(scan.points_lidar)))
        progress(dataset.name)
    drive = PreparedDrive(dataset.name, False, _far_apart(len(scans)), tuple(scans))
    prepare_run_folder(cache)
    save_drive(file, drive, key)
    return drive


def _extractor(weights: Path | None) -> LineExtractor:
    if weights is None:
        return LineExtractor(LineSettings(method="geometric", max_lines=ALL_LINES))
    return LineExtractor(LineSettings(weights=str(weights), max_lines=ALL_LINES))


def _labelled(points: np.ndarray, lines: LineSet) -> PreparedScan:
    count, here = len(lines), np.zeros(len(lines), np.int64)
    sure = np.arange(count) < SURE_LINES  # best first
    landmarks = Landmarks(lines.endpoints, lines.kinds, sure, here, here)
    ids, endpoints, kinds = label_points(points[:, :3], landmarks, np.eye(4), np.zeros((1, 3)))
    return PreparedScan(points, ids, endpoints.astype(np.float32), kinds)


def _far_apart(count: int) -> Float64[np.ndarray, "N 4 4"]:
    """Return poses that make no two scans a pair."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 0, 3] = APART_M * np.arange(count)
    return poses

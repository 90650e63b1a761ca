"""Labels of scans as files: what line each point of a scan belongs to.

One ``NNNNNN.npz`` a scan, numbered as the scan in its sequence, with two arrays that any numpy
reads: ``line_id`` (n,) int32, one for every point of the scan file in its order (0, 1, ... a line;
-1 background; -2 not known), and ``endpoints`` (L, 2, 3) float32, the lines in metres in the lidar
frame. No point of a scan is stored.
"""

import io
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64, Int32

from sl3d_slam.errors import InputError
from sl3d_slam.files import write_whole
from sl3d_slam.geometry.se3 import Points
from sl3d_slam.geometry.segments import Segments
from sl3d_slam.learning.primitives import BACKGROUND, distances_to_segments_m

UNKNOWN = -2
ON_LINE_M, NEAR_LINE_M = 0.2, 0.4
DOUBTFUL_VOTES = 0.9
MIN_MEMBERS = 5
EXPECTED = "labels with line_id (n,) and endpoints (L, 2, 3)"


@dataclass(frozen=True, slots=True, eq=False)
class ScanLabels:
    """The labels of one scan; see the module for what the numbers say."""

    line_id: Int32[np.ndarray, "n"]
    endpoints: Float32[np.ndarray, "L 2 3"]


def write_labels(path: Path, labels: ScanLabels) -> None:
    """Write a label file, whole or not at all. Raises OutputError."""
    buffer = io.BytesIO()
    np.savez_compressed(buffer, line_id=labels.line_id, endpoints=labels.endpoints)
    write_whole(path, buffer.getvalue())


def read_labels(path: Path, num_points: int | None = None) -> ScanLabels:
    """Return the labels of a file; ``num_points`` is the size of the scan they belong to.

    Raises
    ------
    InputError
        naming the file where it is missing, damaged or belongs to another scan.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            line_id, endpoints = file["line_id"], file["endpoints"]
    except (OSError, KeyError, ValueError, EOFError, zipfile.BadZipFile):
        raise InputError(f"{path}: cannot be read; expected {EXPECTED}") from None
    if line_id.ndim != 1 or endpoints.shape[1:] != (2, 3):
        raise InputError(f"{path}: found {line_id.shape}, {endpoints.shape}; expected {EXPECTED}")
    if num_points is not None and len(line_id) != num_points:
        raise InputError(f"{path}: {len(line_id)} labels; expected one for {num_points} points")
    if len(line_id) and not UNKNOWN <= line_id.min() <= line_id.max() < len(endpoints):
        raise InputError(f"{path}: names lines it does not have; expected {EXPECTED}")
    return ScanLabels(line_id.astype(np.int32), endpoints.astype(np.float32))


def label_points(
    points_lidar: Points, votes: np.ndarray, lines: Segments, doubtful: Float64[np.ndarray, "U 2 3"]
) -> ScanLabels:
    """Say for each point which line it belongs to.

    Within 0.2 m of a line: that line. Not known is what lies within 0.4 m of one, or near a
    doubtful line, or has votes above 0.9 and yet made no line. The rest is background, with much
    that a first network takes for lines: from that the next one learns.
    """
    line_id = np.full(len(points_lidar), BACKGROUND, np.int32)
    line_id[votes > DOUBTFUL_VOTES] = UNKNOWN
    for segments, sure in ((doubtful, False), (lines, True)):
        if len(segments) == 0:
            continue
        near = close_to(points_lidar, segments, NEAR_LINE_M)
        distance = distances_to_segments_m(points_lidar[near], segments)
        line_id[near[distance.min(axis=1) < NEAR_LINE_M]] = UNKNOWN
        if sure:
            member = distance.min(axis=1) < ON_LINE_M
            line_id[near[member]] = distance.argmin(axis=1)[member]
    count = np.bincount(line_id[line_id >= 0], minlength=len(lines))
    kept = count >= MIN_MEMBERS
    number = np.append(np.where(kept, np.cumsum(kept) - 1, UNKNOWN), [UNKNOWN, BACKGROUND])
    return ScanLabels(number[line_id].astype(np.int32), lines[kept].astype(np.float32))


def close_to(points: Points, segments: Segments, reach_m: float) -> np.ndarray:
    """Return the points in the box around any segment, so that few distances are computed."""
    low, high = segments.min(axis=1) - reach_m, segments.max(axis=1) + reach_m
    inside = np.zeros(len(points), bool)
    for bottom, top in zip(low, high, strict=True):
        inside |= np.all((points > bottom) & (points < top), axis=1)
    return np.flatnonzero(inside)

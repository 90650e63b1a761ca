"""Labels of scans from files: of towns, whose truth is known, and of drives labelled before."""

import zipfile
from pathlib import Path

import numpy as np
from jaxtyping import Int32
from scipy.spatial import cKDTree

from sl3d_slam.errors import InputError
from sl3d_slam.geometry.se3 import invert
from sl3d_slam.geometry.segments import transform_segments
from sl3d_slam.learning.prepared import BACKGROUND, IGNORED, PreparedScan
from sl3d_slam.types import LineKind

MIN_MEMBERS = 3
LABEL_RADIUS_M = 0.15
STANDING = (LineKind.POLE, LineKind.VERTICAL_EDGE)


def network_labels(
    points: np.ndarray, raw: np.ndarray, line_ids: Int32[np.ndarray, "N"]
) -> Int32[np.ndarray, "M"]:
    """Carry labels of a scan's points (N, 3) over to its network points (M, 3).

    A network point belongs to the line of the nearest point of a line within 0.15 m, as it stands
    for all points around it; else it takes the label of its nearest point.
    """
    nearest = cKDTree(raw).query(points)[1]
    labels = line_ids[nearest].astype(np.int32)
    on_line = np.flatnonzero(line_ids >= 0)
    if len(on_line):
        gap, which = cKDTree(raw[on_line]).query(points, distance_upper_bound=LABEL_RADIUS_M)
        near = np.isfinite(gap)
        labels[near] = line_ids[on_line[which[near]]]
    return labels


def read_town(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return end points and kinds of a town's true lines. Raises InputError."""
    try:
        with np.load(path, allow_pickle=False) as file:
            return file["endpoints"], file["kinds"]
    except (OSError, KeyError, ValueError, zipfile.BadZipFile):
        raise InputError(f"{path}: expected the true lines of a simulated town") from None


def read_labels(path: Path, count: int) -> tuple[Int32[np.ndarray, "N"], np.ndarray]:
    """Return the line of each of a scan's points and the lines (L, 2, 3). Raises InputError."""
    try:
        with np.load(path, allow_pickle=False) as file:
            line_ids = file["line_id"].astype(np.int32)
            endpoints = file["endpoints"] if "endpoints" in file else np.zeros((0, 2, 3))
    except (OSError, KeyError, ValueError, zipfile.BadZipFile):
        raise InputError(f"{path}: expected labels with line_id and endpoints") from None
    if line_ids.shape != (count,):
        raise InputError(f"{path}: {len(line_ids)} labels for a scan of {count} points")
    return line_ids, endpoints.reshape(-1, 2, 3)


def kept_lines(
    points: np.ndarray, ids: np.ndarray, endpoints: np.ndarray, kinds: np.ndarray
) -> PreparedScan:
    """Number the lines that have enough points anew; points of the others are not known."""
    counts = np.bincount(ids[ids >= 0], minlength=len(endpoints))
    enough = counts >= MIN_MEMBERS
    renumber = np.where(enough, np.cumsum(enough) - 1, IGNORED)
    labels = np.where(ids >= 0, renumber[np.maximum(ids, 0)], ids) if len(endpoints) else ids
    return PreparedScan(
        points, labels.astype(np.int32), endpoints[enough].astype(np.float32), kinds[enough]
    )


def town_scan(
    points: np.ndarray, ids: np.ndarray, town: tuple[np.ndarray, np.ndarray], T: np.ndarray
) -> PreparedScan:
    """Keep standing lines, cut to what is seen of them; other edges are not known."""
    endpoints, kinds = town
    seen = np.unique(ids[ids >= 0])
    seen = seen[np.isin(kinds[seen], STANDING)]
    row = np.full(len(kinds) + 1, IGNORED)
    row[seen] = np.arange(len(seen))
    labels = np.where(ids >= 0, row[np.maximum(ids, 0)], BACKGROUND)
    local = transform_segments(invert(T), endpoints[seen])
    cut = [_cut(local[k], points[labels == k, :3]) for k in range(len(seen))]
    return kept_lines(points, labels, np.array(cut).reshape(-1, 2, 3), kinds[seen])


def _cut(segment: np.ndarray, members: np.ndarray) -> np.ndarray:
    along = segment[1] - segment[0]
    t = (members - segment[0]) @ along / max(float(along @ along), 1e-9)
    return segment[0] + np.clip([t.min(), t.max()], 0.0, 1.0)[:, None] * along

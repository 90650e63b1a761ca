"""The picture by which the labels of a scan are judged."""

import numpy as np
from jaxtyping import UInt8

from sl3d_slam.geometry.se3 import Points
from sl3d_slam.geometry.segments import Segments, directions
from sl3d_slam.learning.labels import UNKNOWN, ScanLabels
from sl3d_slam.report.scan_pictures import draw_lines
from sl3d_slam.types import LineKind, LineSet

UPRIGHT_SINE = 0.9
MAX_DRAWN = 40_000


def draw_labels(points_lidar: Points, labels: ScanLabels, title: str) -> bytes:
    """Return a PNG: the scan from above and all around, with its labelled lines."""
    endpoints = labels.endpoints.astype(np.float64)
    lines = LineSet(
        endpoints=endpoints,
        descriptors=np.zeros((len(endpoints), 0), np.float32),
        num_points=np.bincount(
            labels.line_id[labels.line_id >= 0], minlength=len(endpoints)
        ).astype(np.int64),
        kinds=upright_kinds(endpoints),
    )
    unknown = float(np.mean(labels.line_id == UNKNOWN)) if len(labels.line_id) else 0.0
    drawn = np.random.default_rng(0).permutation(len(points_lidar))[:MAX_DRAWN]
    note = f"{title}: {len(lines)} lines, {unknown:.1%} of the points not known"
    return draw_lines(points_lidar[drawn], lines, note)


def upright_kinds(endpoints: Segments) -> UInt8[np.ndarray, "L"]:
    """Tell upright lines from others; whether on a pole or an edge, labels do not know."""
    upright = np.abs(directions(endpoints)[:, 2]) > UPRIGHT_SINE
    return np.where(upright, LineKind.VERTICAL_EDGE, LineKind.OTHER_EDGE).astype(np.uint8)

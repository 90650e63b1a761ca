"""Covariances of keyframe poses as open text, beside the TUM file."""

from pathlib import Path

import numpy as np

from sl3d_slam.files import write_whole
from sl3d_slam.types import KeyframeCovariances

HEADER = """\
# Covariance of the pose T_world_lidar of every keyframe, relative to {relative_to}.
# 6 x 6 in GTSAM's order: rotation about x y z (rad), then translation along x y z (m).
# Frame: the keyframe's own lidar frame, an error acts on the right, T_world_lidar exp(xi).
# stamp scan c11 c12 c13 c14 c15 c16 c21 ... c66 (rows one after another)
"""


def write_covariances(path: Path, covariances: KeyframeCovariances, stamps_s: np.ndarray) -> None:
    """Write a row a keyframe; ``stamps_s`` are those of all scans. Raises OutputError."""
    rows = [
        " ".join([repr(float(stamps_s[scan])), str(scan), *(repr(float(x)) for x in matrix.flat)])
        for scan, matrix in zip(covariances.scans, covariances.covariances, strict=True)
    ]
    header = HEADER.format(relative_to=covariances.relative_to)
    write_whole(path, header + "".join(row + "\n" for row in rows))

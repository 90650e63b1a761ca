"""How far a trajectory is from the truth, by the field's two usual measures."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from sl3d_slam.errors import InputError
from sl3d_slam.geometry.se3 import (
    Points,
    Transform,
    distance_m,
    distances_travelled_m,
    invert,
    make_transform,
    nearest_rotation,
    rotation_angle_rad,
    transform_points,
)
from sl3d_slam.types import LoopRecord

Poses = Float64[np.ndarray, "N 4 4"]
TruePoses = Float64[np.ndarray, "T 4 4"]  # its own letter: that T equals N is checked here

KITTI_LENGTHS_M = (100, 200, 300, 400, 500, 600, 700, 800)
KITTI_STEP = 10


def align(points_b: Points, points_a: Points) -> Transform:
    """Return the rigid ``T_a_b`` that brings paired points closest (Umeyama 1991, scale 1)."""
    centre_a, centre_b = points_a.mean(axis=0), points_b.mean(axis=0)
    R_a_b = nearest_rotation((points_a - centre_a).T @ (points_b - centre_b))
    return make_transform(R_a_b, centre_a - R_a_b @ centre_b)


def aligned_errors_m(estimate: Poses, truth: TruePoses) -> Float64[np.ndarray, "N"]:
    """Return each pose's distance from the truth after the best rigid alignment of all.

    Raises
    ------
    InputError
        when the two do not pair one to one, or are empty.
    """
    _check_pairs(estimate, truth)
    T_truth_estimate = align(estimate[:, :3, 3], truth[:, :3, 3])
    aligned = transform_points(T_truth_estimate, estimate[:, :3, 3])
    return np.linalg.norm(aligned - truth[:, :3, 3], axis=1)


def ate_rmse_m(estimate: Poses, truth: TruePoses) -> float:
    """Return the absolute trajectory error: RMSE over positions, rigidly aligned, no scale.

    The same as ``evo_ape ... -a``. Sturm et al., IROS 2012.

    Raises
    ------
    InputError
        when the two do not pair one to one, or are empty.
    """
    return float(np.sqrt(np.mean(aligned_errors_m(estimate, truth) ** 2)))


def kitti_errors(estimate: Poses, truth: TruePoses) -> tuple[float, float] | None:
    """Return the KITTI odometry errors: (translation in percent, rotation in degrees per metre).

    Relative errors over all stretches of 100, 200, ... 800 m of true path that start at every
    tenth pose, averaged as the KITTI development kit does (Geiger et al., CVPR 2012). Both
    trajectories move the same frame (both camera or both lidar). None where no stretch of 100 m
    fits.

    Raises
    ------
    InputError
        when the two do not pair one to one, or are empty.
    """
    _check_pairs(estimate, truth)
    travelled_m = distances_travelled_m(truth[:, :3, 3])
    translation, rotation = [], []
    for first in range(0, len(truth), KITTI_STEP):
        for length_m in KITTI_LENGTHS_M:
            last = int(np.searchsorted(travelled_m, travelled_m[first] + length_m, side="right"))
            if last == len(truth):
                break
            T_error = _relative_error(estimate, truth, first, last)
            translation.append(distance_m(T_error) / length_m)
            rotation.append(rotation_angle_rad(T_error) / length_m)
    if not translation:
        return None
    return 100.0 * float(np.mean(translation)), float(np.degrees(np.mean(rotation)))


def count_false_loops(
    loops: Sequence[LoopRecord], truth: TruePoses, max_m: float = 2.0, max_deg: float = 5.0
) -> int:
    """Count accepted loops whose ``T_target_query`` is farther from the truth than allowed."""
    accepted = [loop for loop in loops if loop.status == "accepted"]
    return sum(_is_false(loop, truth, max_m, max_deg) for loop in accepted)


def _is_false(loop: LoopRecord, truth: TruePoses, max_m: float, max_deg: float) -> bool:
    T_truth = invert(truth[loop.target_scan]) @ truth[loop.query_scan]
    T_error = invert(T_truth) @ loop.T_target_query
    angle_deg = float(np.degrees(rotation_angle_rad(T_error)))
    return distance_m(T_error) > max_m or angle_deg > max_deg


def _relative_error(estimate: Poses, truth: TruePoses, first: int, last: int) -> Transform:
    T_true = invert(truth[first]) @ truth[last]
    T_estimated = invert(estimate[first]) @ estimate[last]
    return invert(T_estimated) @ T_true


def _check_pairs(estimate: Poses, truth: TruePoses) -> None:
    if len(estimate) != len(truth) or len(truth) == 0:
        raise InputError(
            f"expected one true pose for each estimated pose, found {len(truth)} for "
            f"{len(estimate)}"
        )

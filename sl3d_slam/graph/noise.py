"""Covariances of relative poses, and the only place where they become gtsam noise models.

Every 6 x 6 matrix is in GTSAM's order (rotation first) at the right-hand frame of its transform.
"""

import gtsam
import numpy as np
from jaxtyping import Float64

from sl3d_slam.config import GraphSettings
from sl3d_slam.errors import GraphError
from sl3d_slam.geometry.se3 import (
    Transform,
    adjoint,
    distance_m,
    exp,
    invert,
    log,
)

Matrix6 = Float64[np.ndarray, "6 6"]

MAX_SIGMA = 1e3  # a direction looser than 1,000 rad or 1,000 m is not measured at all
MAX_CONDITION = 1e12


def weakness(information: Matrix6) -> str:
    """Say why an information matrix may not enter a graph; empty where it may.

    It must be finite, symmetric and fix all six directions: the weakest one to better than
    ``MAX_SIGMA`` and not ``MAX_CONDITION`` times worse than the strongest.
    """
    if not np.isfinite(information).all():
        return "its information holds values that are not finite"
    scale = float(np.abs(information).max())
    if not np.allclose(information, information.T, rtol=0.0, atol=1e-6 * max(scale, 1e-300)):
        return "its information is not symmetric"
    eigenvalues = np.linalg.eigvalsh(0.5 * (information + information.T))
    floor = max(MAX_SIGMA**-2, float(eigenvalues[-1]) / MAX_CONDITION)
    num_free = int(np.sum(eigenvalues < floor))
    if num_free:
        return f"its information leaves {num_free} of 6 directions free"
    return ""


def information_to_gtsam(information: Matrix6) -> gtsam.noiseModel.Gaussian:
    """Turn an information matrix (rotation first) into a Gaussian noise model.

    Raises
    ------
    GraphError
        where the matrix is not finite, not symmetric or rank deficient: such a factor would make
        the whole system indeterminate.
    """
    reason = weakness(information)
    if reason:
        raise GraphError(f"the factor cannot enter a graph: {reason}; expected full rank")
    symmetric = 0.5 * (information + information.T)
    return gtsam.noiseModel.Gaussian.Information(symmetric, False)


def covariance_to_gtsam(covariance: Matrix6) -> gtsam.noiseModel.Gaussian:
    """Turn a covariance (rotation first, positive definite) into a Gaussian noise model."""
    symmetric = 0.5 * (covariance + covariance.T)
    return gtsam.noiseModel.Gaussian.Covariance(symmetric, False)


def step_covariance(T_last_lidar: Transform, settings: GraphSettings) -> Matrix6:
    """Return the covariance of one odometry step between successive scans, at the newer scan."""
    rotation_rad = np.hypot(
        np.radians(settings.odometry_rotation_sigma_deg),
        settings.odometry_rotation_fraction * _angle_rad(T_last_lidar),
    )
    translation_m = np.hypot(
        settings.odometry_translation_sigma_m,
        settings.odometry_translation_fraction * distance_m(T_last_lidar),
    )
    return np.diag(np.repeat([rotation_rad**2, translation_m**2], 3))


def covariance_of_step(T_last_lidar: Transform, last: Matrix6, lidar: Matrix6) -> Matrix6:
    """Return the covariance of a step, at the newer scan, from those of both poses' errors.

    Each pose errs on its own, at its own frame: the older one's error reaches the newer one by
    ``Ad(T_last_lidar)^-1``.
    """
    carry = adjoint(invert(T_last_lidar))
    return carry @ last @ carry.T + lidar


def _angle_rad(T_a_b: Transform) -> float:
    """Return the angle of a rotation without the detour of a general parser: one a scan."""
    R = T_a_b[:3, :3]
    twice_sine = np.sqrt(
        (R[2, 1] - R[1, 2]) ** 2 + (R[0, 2] - R[2, 0]) ** 2 + (R[1, 0] - R[0, 1]) ** 2
    )
    return float(np.arctan2(twice_sine, R[0, 0] + R[1, 1] + R[2, 2] - 1.0))


def chain_covariance(T_first_last: Transform, num_scans: int, settings: GraphSettings) -> Matrix6:
    """Return the covariance of ``num_scans`` equal steps that lead from first to last, at last.

    Each step is ``S = exp(log(T_first_last) / num_scans)`` with the noise of
    :func:`step_covariance`, so ``P <- Ad(S)^-1 P Ad(S)^-T + P_step``: a rotation error early in
    the chain moves everything after it.
    """
    if num_scans < 1:
        raise GraphError(f"an odometry chain needs at least 1 scan, got {num_scans}")
    if num_scans == 1:
        return step_covariance(T_first_last, settings)
    T_last_next = exp(log(T_first_last) / num_scans)
    step = step_covariance(T_last_next, settings)
    carry = adjoint(invert(T_last_next))
    covariance = step
    for _ in range(num_scans - 1):
        covariance = carry @ covariance @ carry.T + step
    return covariance

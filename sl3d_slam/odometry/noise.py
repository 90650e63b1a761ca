"""How far an odometry pose may be off, from the alignment of its surfaces."""

import numpy as np
from jaxtyping import Float64

Matrix6 = Float64[np.ndarray, "6 6"]

COVARIANCE_SCALE = 0.55
USUAL_MISFIT = 0.1
MISFIT_LIMITS = (0.05, 0.4)
TILT_SIGMA_RAD = np.radians(0.0036)
LOOSE = np.diag(np.repeat([1e2, 1.0], 3))  # 0.1 rad and 1 m: where a scan shows nothing at all
LEAST_SIGMAS = np.array([0.0, 0.0, np.radians(0.0005), 2e-4, 2e-4, 2e-4])
GRID = np.repeat([1e-6, 1e-5], 3)  # rad, m: the covariance is rounded as the pose is


def pose_covariance(hessian: Matrix6, misfit: float) -> Matrix6:
    """Return the covariance of a pose given the map it was aligned to, at the lidar's frame.

    Rotation first, as the Hessian H of voxelised GICP; ``misfit`` is its mean cost of a point that
    found a partner. H^-1 alone is too small, and a scan whose surfaces do not lie well on the map
    errs far more: the covariance is ``COVARIANCE_SCALE r^3 H^-1`` with r the misfit by the usual
    one, and roll and pitch get ``(TILT_SIGMA_RAD r^4)^2`` more: where rings are far apart (HDL-32)
    nothing else shows how badly far surfaces are known.

    A step's error is that of both its ends, which ``graph.final.odometry_edges`` adds up.
    Calibrated on 1,200 steps of six simulated towns: HDL-64 3.5 to 8.6, HDL-32 11.7 and 12.8 mean
    normalised error squared of six degrees of freedom. On seven stretches of other towns HDL-64
    had 4.1 to 6.2 and HDL-32 7.5, an OS1-128 2.7; one constant had 0.6 to 25. Real drives by GPS
    come out larger, their truth is centimetres off itself.
    """
    ratio = float(np.clip(misfit, *MISFIT_LIMITS)) / USUAL_MISFIT
    tilt = TILT_SIGMA_RAD * ratio**4
    extra = np.diag(LEAST_SIGMAS**2 + np.array([tilt**2, tilt**2, 0.0, 0.0, 0.0, 0.0]))
    covariance = COVARIANCE_SCALE * ratio**3 * np.linalg.inv(hessian + LOOSE) + extra
    unit = np.outer(GRID, GRID)
    return np.round(0.5 * (covariance + covariance.T) / unit) * unit

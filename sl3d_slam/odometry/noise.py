"""How far an odometry pose may be off, from the alignment of its surfaces."""

import numpy as np
from jaxtyping import Float64

from sl3d_slam.geometry.surface_fit import LOOSE

Matrix6 = Float64[np.ndarray, "6 6"]

COVARIANCE_SCALE = 0.03
USUAL_MISFIT = 0.1
MISFIT_LIMITS = (0.05, 0.4)
LEAST_SIGMAS = np.array([0.0, 0.0, np.radians(0.00025), 1e-4, 1e-4, 1e-4])
GRID = np.repeat([1e-6, 1e-5], 3)  # rad, m: the covariance is rounded as the pose is


def pose_covariance(hessian: Matrix6, misfit: float) -> Matrix6:
    """Return the covariance of a pose given the map it was aligned to, at the lidar's frame.

    Rotation first, as the Hessian H of voxelised GICP; ``misfit`` is its mean cost of a point that
    found a partner. H^-1 alone is too small, and a scan whose surfaces do not lie well on the map
    errs far more: the covariance is ``COVARIANCE_SCALE r^2 H^-1`` with r the misfit by the usual
    one, and never below what the grid of the poses leaves.

    A step's error is that of both its ends, which ``graph.final.odometry_edges`` adds up.
    Calibrated on 1,150 steps of seven simulated stretches: mean normalised error squared of six
    degrees of freedom 3.6 to 6.6 with an HDL-32E, up to 9.6 with an HDL-64E, 2.3 and 2.4 with an
    OS1-128 (better than it says, most so in height, roll and pitch). Towns that it never saw have
    7.1, 4.4 and 3.4. Real drives by GPS come out larger, their truth is centimetres off itself.
    """
    ratio = float(np.clip(misfit, *MISFIT_LIMITS)) / USUAL_MISFIT
    covariance = COVARIANCE_SCALE * ratio**2 * np.linalg.inv(hessian + LOOSE)
    covariance += np.diag(LEAST_SIGMAS**2)
    unit = np.outer(GRID, GRID)
    return np.round(0.5 * (covariance + covariance.T) / unit) * unit

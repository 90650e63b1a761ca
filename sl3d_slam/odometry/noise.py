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

    Rotation first, as the Hessian H of the surfaces' fit, whose ``misfit`` is the weighted mean
    cost of a point. H takes voxels for exact and points for independent; what remains after the
    robust kernel is smaller than that by a constant: the covariance is ``COVARIANCE_SCALE r^2
    H^-1`` with r the misfit by the usual one, and never below what the grid of the poses leaves.

    A step's error is that of both its ends, which ``graph.final.odometry_edges`` adds up.
    Calibrated on 1,650 steps of ten simulated stretches (HDL-64E, HDL-32E, OS1-128; one in dense
    traffic): mean normalised error squared of six degrees of freedom 4.0 to 8.5. Real drives by GPS
    come out larger, their truth is centimetres off itself.
    """
    ratio = float(np.clip(misfit, *MISFIT_LIMITS)) / USUAL_MISFIT
    covariance = COVARIANCE_SCALE * ratio**2 * np.linalg.inv(hessian + LOOSE)
    covariance += np.diag(LEAST_SIGMAS**2)
    unit = np.outer(GRID, GRID)
    return np.round(0.5 * (covariance + covariance.T) / unit) * unit

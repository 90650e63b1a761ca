"""Millimetres from coarse clouds: GICP by small_gicp, surfaces laid robustly, what is left free."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import small_gicp
from jaxtyping import Float32, Float64

from sl3d_slam.geometry.gaussian_voxels import GaussianVoxels, Surfaces, Voxels
from sl3d_slam.geometry.se3 import Points, Transform
from sl3d_slam.geometry.surface_fit import SurfaceFit, lay_on
from sl3d_slam.geometry.voxel_means import voxel_means

MAX_RANGE_M = 70.0
MIN_POINTS = 100
NEIGHBOURS = 12
THREADS = 2
# largest correspondence distance, voxel of the moving cloud; a last stage of 1 m and 1 m leaves
# twice the error
STAGES = ((3.0, 2.0), (0.6, 0.7))
UNITS = np.repeat([np.radians(0.015), 0.01], 3)  # a step of each that moves a scan about equally
# Calibrated on simulated drives, see information_of
COVARIANCE_SCALE = 0.022
LOOSE_VARIANCE = 0.1  # in UNITS; a direction held so loosely errs twice as much as noise says
USUAL_MISFIT, LEAST_MISFIT = 0.15, 0.05
MIN_SIGMAS = np.array([*np.radians([0.01, 0.01, 0.003]), 5e-4, 5e-4, 5e-4])
LITTLE_SUPPORT, LEAST_SUPPORT = 0.18, 0.02  # where so little lies well the covariance has doubled
# surfaces hold a little along themselves, too (1 to 1,000): a bare corridor reaches 0.0024 of the
# best-held direction, real streets slid by 4 m 0.0026 to 0.0043, true pairs 25 m apart 0.0049 up
FREE_RATIO = 0.0045


class DenseCloud:
    """A coarse cloud that others are aligned to: points with covariances, and their tree."""

    def __init__(self, cloud: Float32[np.ndarray, "M 3"]) -> None:
        self.points = small_gicp.PointCloud(cloud.astype(np.float64))
        self.tree = small_gicp.KdTree(self.points)
        # a point at a time: the same for any number of threads
        small_gicp.estimate_normals_covariances(
            self.points, self.tree, num_neighbors=NEIGHBOURS, num_threads=THREADS
        )

    @cached_property
    def voxels(self) -> Voxels:
        """The cloud's surfaces for others to be laid on."""
        voxels = GaussianVoxels()
        voxels.insert(Surfaces.of(self.points), np.eye(4))
        return voxels.rows


MovingClouds = tuple[small_gicp.PointCloud, ...]  # one a stage


@dataclass(frozen=True, slots=True, eq=False)
class DenseAlignment:
    """Where surfaces lie, and the share of the moving points for which GICP found a partner."""

    fit: SurfaceFit
    overlap: float


def coarse_cloud(points_lidar: Points, voxel_m: float) -> Float32[np.ndarray, "M 3"]:
    """Thin a scan to voxel means within 70 m, the cloud that views and maps keep."""
    return voxel_means(points_lidar, voxel_m, MAX_RANGE_M).astype(np.float32)


def prepare(cloud: Float32[np.ndarray, "M 3"]) -> DenseCloud | None:
    """Estimate covariances and build the tree; None where there are too few points to align."""
    if len(cloud) < MIN_POINTS:
        return None  # small_gicp would answer with the identity
    return DenseCloud(cloud)


def thin(cloud: Float32[np.ndarray, "M 3"]) -> MovingClouds | None:
    """Thin a coarse cloud for the moving side; None where it has too few points to align."""
    if len(cloud) < MIN_POINTS:
        return None
    points = cloud.astype(np.float64)
    return tuple(
        small_gicp.preprocess_points(points, voxel_m, num_neighbors=NEIGHBOURS)[0]
        for _, voxel_m in STAGES
    )


def align(target: DenseCloud, source: MovingClouds, T_target_source: Transform) -> DenseAlignment:
    """Refine a first guess, coarse then fine. Deterministic: one thread."""
    T, result = T_target_source, None
    for (reach_m, _), moving in zip(STAGES, source, strict=True):
        result = small_gicp.align(
            target.points,
            moving,
            target.tree,
            init_T_target_source=T,
            max_correspondence_distance=reach_m,
            max_iterations=25,
        )
        T = np.asarray(result.T_target_source)
    assert result is not None
    return finish(target, source[-1], result)


def finish(
    target: DenseCloud, moving: small_gicp.PointCloud, result: small_gicp.RegistrationResult
) -> DenseAlignment:
    """Lay the moving surfaces robustly from where GICP ended.

    GICP takes the nearest point for a partner, and rings lie where the sensor stood: what remains
    of that, and of what moved between the scans, falls to a third.
    """
    fit = lay_on(target.voxels, Surfaces.of(moving), np.asarray(result.T_target_source))
    return DenseAlignment(fit, float(result.num_inliers / max(1, moving.size())))


def information_of(fit: SurfaceFit) -> Float64[np.ndarray, "6 6"]:
    """Return the calibrated information of an alignment (rotation first, source frame).

    The Hessian H takes every point as independent and every surface as flat. The covariance of
    noise is ``COVARIANCE_SCALE (misfit / USUAL_MISFIT)^4 H^-1``, growing with the square of the
    support as it falls (views that share little share what both see at a slant). In a direction
    that is held loosely what is common to many points counts for more: the variance v of noise
    becomes ``v (1 + sqrt(v / LOOSE_VARIANCE))``. Last come least variances. Directions that no
    point fixes stay exactly zero.

    Fitted on pairs of views in thirteen simulated towns (HDL-64E, HDL-32E, OS1-128), where the mean
    normalised error squared is 3.8 to 10.7 for six degrees of freedom; in three that it never saw
    5.7, 3.3 and 3.4. ``sl3d bench covariance`` measures it on any drive with true poses.
    """
    values, vectors = np.linalg.eigh(fit.hessian * np.outer(UNITS, UNITS))
    fixed = values > FREE_RATIO * max(float(values[-1]), 1e-12)
    basis = vectors[:, fixed]
    least = (basis.T * (MIN_SIGMAS / UNITS) ** 2) @ basis
    misfit = max(fit.misfit, LEAST_MISFIT) / USUAL_MISFIT
    growth = misfit**4 * (1.0 + (LITTLE_SUPPORT / max(fit.support, LEAST_SUPPORT)) ** 2)
    noise = COVARIANCE_SCALE * growth / values[fixed]
    covariance = np.diag(noise * (1.0 + np.sqrt(noise / LOOSE_VARIANCE))) + least
    information = basis @ np.linalg.inv(covariance) @ basis.T
    return 0.5 * (information + information.T) / np.outer(UNITS, UNITS)

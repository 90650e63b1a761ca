"""Centimetres from coarse clouds: two-stage GICP by small_gicp, and what it leaves free."""

from dataclasses import dataclass

import numpy as np
import small_gicp
from jaxtyping import Float32, Float64

from sl3d_slam.geometry.se3 import Points, Transform
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
COVARIANCE_SCALE = 1.7
USUAL_MISFIT, LEAST_MISFIT = 0.15, 0.05
MIN_SIGMAS = np.repeat([np.radians(0.003), 5e-4], 3)
FAR_M = 50.0  # between the views: there they share so little that the covariance has doubled
# GICP's surfaces hold a little along themselves, too (1 to 1,000): a bare corridor reaches 0.0024
# of the best-held direction, a street slid by 4 m 0.0038, true pairs 25 m apart on real streets
# 0.0064 and more
FREE_RATIO = 0.005


class DenseCloud:
    """A coarse cloud that others are aligned to: points with covariances, and their tree."""

    def __init__(self, cloud: Float32[np.ndarray, "M 3"]) -> None:
        self.points = small_gicp.PointCloud(cloud.astype(np.float64))
        self.tree = small_gicp.KdTree(self.points)
        small_gicp.estimate_covariances(  # a point at a time: the same for any number of threads
            self.points, self.tree, num_neighbors=NEIGHBOURS, num_threads=THREADS
        )


MovingClouds = tuple[small_gicp.PointCloud, ...]  # one a stage


@dataclass(frozen=True, slots=True, eq=False)
class DenseAlignment:
    """Where GICP ended.

    Attributes
    ----------
    hessian : rotation first, at the source frame.
    overlap : share of the moving points that found a partner.
    misfit : GICP's mean cost of those.
    """

    T_target_source: Transform
    hessian: Float64[np.ndarray, "6 6"]
    overlap: float
    misfit: float = USUAL_MISFIT


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
    return alignment_of(result, source[-1].size())


def alignment_of(result: small_gicp.RegistrationResult, num_moving: int) -> DenseAlignment:
    """Keep what counts of small_gicp's answer."""
    return DenseAlignment(
        np.asarray(result.T_target_source),
        np.asarray(result.H),
        overlap=float(result.num_inliers / max(1, num_moving)),
        misfit=float(result.error / max(1, result.num_inliers)),
    )


def information_of(alignment: DenseAlignment) -> Float64[np.ndarray, "6 6"]:
    """Return the calibrated information of an alignment (rotation first, source frame).

    GICP's Hessian H takes every point as independent and every surface as flat, so its inverse is
    too small, the more so the worse the surfaces lie on each other. The covariance is
    ``COVARIANCE_SCALE (misfit / USUAL_MISFIT)^2 (H^-1 + least variances)``, growing with the
    fourth power of the distance between the views: up to 30 m it hardly matters, beyond 45 m they
    share little but what both see at a slant. Directions that no point fixes stay exactly zero.

    Calibrated on 285 pairs of views up to 45 m apart in six simulated towns (HDL-64 and HDL-32), so
    that the mean normalised error squared is six for six degrees of freedom, the growth on 136 up
    to 60 m in three more. In towns that it never saw 35 pairs of an HDL-32E then had 8.1 (9.9 where
    the growth was the square's) and 42 of an HDL-64E 7.4. An OS1-128, whose rings are dense, is
    better than it says (3.0). Single pairs reach 30, from an HDL-32 some 100 (its rings are too far
    apart beyond 30 m to show how a surface lies: pitch errs by up to 0.2 deg). ``sl3d bench
    covariance`` measures it on any drive with true poses: those of real drives by GPS are
    centimetres off themselves, so there it comes out larger.
    """
    values, vectors = np.linalg.eigh(alignment.hessian * np.outer(UNITS, UNITS))
    fixed = values > FREE_RATIO * max(float(values[-1]), 1e-12)
    basis = vectors[:, fixed]
    distance_m = float(np.linalg.norm(alignment.T_target_source[:3, 3]))
    least = (basis.T * (MIN_SIGMAS / UNITS) ** 2) @ basis
    misfit = max(alignment.misfit, LEAST_MISFIT) / USUAL_MISFIT
    growth = misfit**2 * (1.0 + (distance_m / FAR_M) ** 4)
    covariance = COVARIANCE_SCALE * growth * (np.diag(1.0 / values[fixed]) + least)
    information = basis @ np.linalg.inv(covariance) @ basis.T
    return 0.5 * (information + information.T) / np.outer(UNITS, UNITS)

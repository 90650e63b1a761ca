"""Scan -> RegisteredScan by KISS-ICP (Vizzo et al., RA-L 2023), refined on surfaces.

Hazards of the library that this file meets: its deskewing aborts the process when all point
times are equal; and its threads add up sums in a different order from run to run, which changes
the last bits of a pose. Each pose is therefore rounded to a grid far below the sensor's noise
before it is used, so that two runs agree bit for bit. The last hazard is the second scan:
with no velocity known, a moving vehicle's scan rings on the ground hold ICP at standstill (measured
on a KITTI drive at 14 m/s: 0.06 m found, 1.44 m true), so that one is tried from several starts.
"""

from typing import TypeGuard

import numpy as np
from kiss_icp.mapping import get_voxel_hash_map
from kiss_icp.preprocess import get_preprocessor
from kiss_icp.registration import get_registration
from kiss_icp.threshold import get_threshold_estimator
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from sl3d_slam.config import InputSettings, OdometrySettings
from sl3d_slam.geometry.gaussian_voxels import Surfaces
from sl3d_slam.geometry.se3 import (
    Points,
    Transform,
    invert,
    make_transform,
    transform_points,
)
from sl3d_slam.geometry.voxel_means import first_in_voxels
from sl3d_slam.odometry.kiss_settings import kiss_config, with_step
from sl3d_slam.odometry.noise import Matrix6, pose_covariance
from sl3d_slam.odometry.starts import mean_gap_m, standing_points, start_positions
from sl3d_slam.odometry.surface_map import SurfaceMap
from sl3d_slam.odometry.surfaces import surfaces_of
from sl3d_slam.types import RegisteredScan, Scan

TRANSLATION_GRID_M = 1e-5
QUATERNION_GRID = 1e-7
COARSE_STEP_M = 0.02
COARSE_SOURCE_VOXELS = 3.0
SOURCE_VOXELS = 1.5
START_GAIN = 0.95


class Odometry:
    """Registers each scan against a local map of the scans before it.

    The first scan gets the identity. ``T_odom_lidar`` and the points of a scan with point times
    refer to the time of its last point (KISS-ICP's choice), else to the scan as it is given.
    """

    def __init__(self, settings: OdometrySettings, scan_input: InputSettings) -> None:
        config = kiss_config(settings, scan_input)
        self._input = scan_input
        self._voxel_size_m = settings.voxel_size_m
        self._preprocessor = get_preprocessor(config)
        self._threshold = get_threshold_estimator(config)
        self._coarse = get_registration(with_step(config, COARSE_STEP_M))
        self._fine = get_registration(config)
        self._local_map = get_voxel_hash_map(config)
        self._T_odom_last: Transform = np.eye(4)
        self._T_last_next: Transform = np.eye(4)
        self._surfaces = SurfaceMap()
        self._refines = settings.refine_on_surfaces
        self._covariance: Matrix6 | None = None  # of the last pose that surfaces refined
        self._first_points: Points | None = None
        self._count = 0

    def register(self, scan: Scan, T_known: Transform | None = None) -> RegisteredScan:
        """Deskew a scan, find its pose in the odometry frame and add it to the local map.

        ``T_known`` is what an earlier run found for this scan; it is then not looked for again.
        """
        points = self._prepared(scan)
        map_points = first_in_voxels(points, 0.5 * self._voxel_size_m)
        surfaces = surfaces_of(map_points) if self._refines else None
        guess = self._T_odom_last @ self._T_last_next
        self._covariance = None
        T_odom_lidar = self._find_pose(map_points, surfaces, guess) if T_known is None else T_known
        self._threshold.update_model_deviation(invert(guess) @ T_odom_lidar)
        self._first_points = points if self._count == 0 else None
        self._count += 1
        self._local_map.update(map_points, T_odom_lidar)
        if surfaces is not None:
            self._surfaces.insert(surfaces, T_odom_lidar)
        self._T_last_next = invert(self._T_odom_last) @ T_odom_lidar
        self._T_odom_last = T_odom_lidar
        return RegisteredScan(scan.index, scan.stamp_s, points, T_odom_lidar, self._covariance)

    def _prepared(self, scan: Scan) -> Points:
        """Leave out what is out of range; move points to where they were at the last one's time.

        Without point times nothing moves, and a scan that is in range already is not copied.
        """
        times_s = scan.point_times_s
        if times_s is not None and np.ptp(times_s) > 0.0:
            return self._preprocessor.preprocess(scan.points_lidar, times_s, self._T_last_next)
        points = np.ascontiguousarray(scan.points_lidar)
        squared, limits = np.einsum("ij,ij->i", points, points), self._input
        in_range = (squared > limits.min_range_m**2) & (squared < limits.max_range_m**2)
        return points if in_range.all() else points.compress(in_range, axis=0)

    def _find_pose(
        self, map_points: Points, surfaces: Surfaces | None, guess: Transform
    ) -> Transform:
        """Find the pose near the constant-velocity guess, by full effort where a quick one fails.

        Surfaces need only be led near: a quarter of KISS-ICP's points and steps of 2 cm make no
        difference of a millimetre, unless the vehicle starts to turn or brakes hard. Then the
        surfaces have far to go or do not settle (1 scan in 150), and a full alignment leads them.
        """
        if self._first_points is not None:
            guess = self._best_start(map_points, surfaces, cKDTree(self._first_points))
        elif self._can_refine(surfaces):
            T_odom_led = self._lead(map_points, guess, quickly=True)
            T_odom_lidar, settled = self._refine(surfaces, T_odom_led)
            if settled:
                return _on_grid(T_odom_lidar)
        return _on_grid(self._align(map_points, surfaces, guess))

    def _align(
        self,
        map_points: Points,
        surfaces: Surfaces | None,
        guess: Transform,
        quickly: bool = False,
    ) -> Transform:
        """Align points to points by KISS-ICP, then, where asked, surfaces to surfaces."""
        T_odom_lidar = self._lead(map_points, guess, quickly)
        if self._can_refine(surfaces):
            T_odom_lidar, _ = self._refine(surfaces, T_odom_lidar)
        return T_odom_lidar

    def _can_refine(self, surfaces: Surfaces | None) -> TypeGuard[Surfaces]:
        return surfaces is not None and len(surfaces.points) > 0 and self._surfaces.num_voxels > 0

    def _refine(self, surfaces: Surfaces, T_odom_led: Transform) -> tuple[Transform, bool]:
        """Align surfaces to surfaces; also tell whether they settled where they were led to.

        The scan rings on the ground move with the sensor: point-to-point matches let them hold it
        back, most where it creeps or turns and the adaptive threshold is wide. Matched as surfaces
        rings only fix the height.
        """
        found = self._surfaces.align(surfaces, T_odom_led)
        self._covariance = pose_covariance(found.fit.hessian, found.fit.misfit)
        return found.fit.T_target_source, found.settled

    def _lead(self, map_points: Points, guess: Transform, quickly: bool) -> Transform:
        """Align points to points, by a quarter of the points and larger steps where it is quick."""
        registration = self._coarse if quickly else self._fine
        voxels = COARSE_SOURCE_VOXELS if quickly else SOURCE_VOXELS
        sigma_m = self._threshold.get_threshold()
        return registration.align_points_to_map(
            points=first_in_voxels(map_points, voxels * self._voxel_size_m),
            voxel_map=self._local_map,
            initial_guess=guess,
            max_correspondance_distance=3.0 * sigma_m,
            kernel=sigma_m,
        )

    def _best_start(
        self, map_points: Points, surfaces: Surfaces | None, first: cKDTree
    ) -> Transform:
        """Try standstill and a step in four directions; standstill wins near ties.

        Quick tries tell which start is right where surfaces follow them, points alone do not.
        """
        standing, quickly = standing_points(map_points), self._can_refine(surfaces)
        best, best_gap_m = np.eye(4), np.inf
        for position in start_positions():
            start = make_transform(np.eye(3), position)
            T_odom_lidar = self._align(map_points, surfaces, start, quickly)
            gap_m = mean_gap_m(transform_points(T_odom_lidar, standing), first)
            if gap_m < START_GAIN * best_gap_m:
                best, best_gap_m = start, gap_m
        return best


def _on_grid(T_a_b: Transform) -> Transform:
    """Round a pose to 10 micrometres and 1e-7 in the quaternion."""
    quat_xyzw = Rotation.from_matrix(T_a_b[:3, :3]).as_quat(canonical=True)
    rotation = Rotation.from_quat(np.round(quat_xyzw / QUATERNION_GRID) * QUATERNION_GRID)
    translation = np.round(T_a_b[:3, 3] / TRANSLATION_GRID_M) * TRANSLATION_GRID_M
    return make_transform(rotation.as_matrix(), translation)

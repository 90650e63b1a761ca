"""The surfaces that odometry aligns: walls and ground stay, rings across far walls go."""

from itertools import pairwise

import numpy as np
import pytest

from sl3d_slam.config import InputSettings, OdometrySettings
from sl3d_slam.geometry.se3 import invert, log
from sl3d_slam.odometry.odometry import Odometry
from sl3d_slam.odometry.surfaces import surfaces_of
from sl3d_slam.simulation.drive import plan_drive, simulate_drive
from sl3d_slam.simulation.roads import builtin_road
from sl3d_slam.simulation.town import build_town
from sl3d_slam.types import Scan

HEIGHT_M = 1.7


def sparse_scan(rng):
    """Rings 4/3 deg apart, as an HDL-32E's, in a canyon: ground and a wall 45 m to the left."""
    elevation = np.radians(10.67 - np.arange(32) * 4 / 3)
    azimuth = np.radians(np.arange(0.0, 180.0, 0.2))
    up, along = (array.ravel() for array in np.meshgrid(elevation, azimuth, indexing="ij"))
    beams = np.stack([np.cos(up) * np.cos(along), np.cos(up) * np.sin(along), np.sin(up)], axis=1)
    with np.errstate(divide="ignore"):
        to_wall_m = 45.0 / beams[:, 1]
        to_ground_m = np.where(beams[:, 2] < 0, -HEIGHT_M / beams[:, 2], np.inf)
    range_m = np.minimum(to_wall_m, to_ground_m)
    range_m += rng.normal(0.0, 0.02, len(range_m))
    seen = (range_m > 2.0) & (range_m < 90.0)
    return np.ascontiguousarray(beams[seen] * range_m[seen, None])


def test_rings_across_a_far_wall_are_no_floors_and_near_ground_stays(rng):
    scan = sparse_scan(rng)
    surfaces = surfaces_of(scan)
    points = surfaces.points
    upwards = np.abs(surfaces.normals[:, 2]) > 0.9
    above = points[:, 2] > 0.0
    assert above.sum() > 100  # of the wall something is left
    assert (upwards & above).sum() < 0.01 * above.sum()
    near = np.hypot(points[:, 0], points[:, 1]) < 12.0
    assert near.sum() > 300
    assert upwards[near].mean() > 0.95


def test_points_that_span_no_surface_are_none():
    assert len(surfaces_of(np.zeros((0, 3))).points) == 0
    assert len(surfaces_of(np.array([[25.0, 0.0, 0.0]])).points) == 0


@pytest.mark.slow
def test_sparse_rings_hold_roll_and_pitch_to_hundredths_of_a_degree():
    """With the floors that are none it is three times as much."""
    planned = plan_drive(build_town(builtin_road("demo"), seed=303), sensor="hdl32", scans=30)
    odometry = Odometry(OdometrySettings(), InputSettings())
    poses = [
        odometry.register(Scan(k, 0.1 * k, scan.points_lidar)).T_odom_lidar
        for k, scan in enumerate(simulate_drive(planned, range(30)))
    ]
    errors = [
        log(invert(invert(true_a) @ true_b) @ invert(a) @ b)
        for (a, b), (true_a, true_b) in zip(
            pairwise(poses), pairwise(planned.T_town_lidar), strict=True
        )
    ]
    tilt_deg = np.degrees(np.sqrt(np.mean(np.array(errors[2:])[:, :2] ** 2, axis=0)))
    assert tilt_deg.max() < 0.02

"""Planar fits to all lines that agree, and GICP that looks no farther than they err."""

import numpy as np
import pytest

from sl3d_slam.geometry.se3 import distance_m, from_yaw, invert, rotation_angle_rad
from sl3d_slam.matching import dense
from sl3d_slam.matching.refine import align_near, fit_planar, moving_cloud
from sl3d_slam.matching.verticals import Verticals

TRUE = np.array([np.radians(137.0), 8.0, -5.0])
NOISE_M = 0.05


def verticals(xy):
    count = len(xy)
    heights = np.tile([-1.5, 3.0], (count, 1))
    none = np.zeros((count, 0), np.float32)
    return Verticals(xy, heights, np.ones(count), none, np.arange(count))


def moved(pose, xy):
    return xy @ from_yaw(pose[0], np.zeros(3))[:2, :2].T + pose[1:]


@pytest.fixture
def twelve(rng):
    """Twelve poles seen from two places with 5 cm of noise; the target sees 3 others, too."""
    source = rng.uniform(-30, 30, (12, 2))
    target = moved(TRUE, source) + rng.normal(0, NOISE_M, (12, 2))
    return source, np.concatenate([target, rng.uniform(-40, 40, (3, 2))])[rng.permutation(15)]


def test_all_lines_together_beat_the_two_that_began(twelve):
    source, target = twelve
    rough = TRUE + np.array([np.radians(0.5), 0.2, -0.2])
    pose = fit_planar(verticals(source), verticals(target), rough, 0.6)
    assert np.hypot(*(pose[1:] - TRUE[1:])) < 3 * NOISE_M / np.sqrt(12) * 2  # 3 sigma, two axes
    assert abs(pose[0] - TRUE[0]) < 3 * NOISE_M / (17.0 * np.sqrt(12))  # 17 m: rms of the lever


def test_a_line_that_stands_wrong_hardly_pulls(rng):
    source = rng.uniform(-30, 30, (12, 2))
    target = moved(TRUE, source)
    target[4] += [0.5, 0.0]
    pose = fit_planar(
        verticals(source), verticals(target), TRUE + np.array([0.002, 0.05, 0.05]), 0.6
    )
    assert np.hypot(*(pose[1:] - TRUE[1:])) < 0.01  # a plain mean would be off by 0.5 / 12 = 0.04


@pytest.mark.parametrize("count", [0, 1])
def test_with_fewer_than_two_lines_the_guess_stays(rng, count):
    xy = rng.uniform(-30, 30, (count, 2))
    pose = fit_planar(verticals(xy), verticals(moved(TRUE, xy)), TRUE + 0.01, 0.6)
    np.testing.assert_array_equal(pose, TRUE + 0.01)


def room(rng, T_room_lidar):
    """A street corner 30 m wide: ground and three walls, seen from a pose in it."""
    u, v = rng.uniform(-15, 15, (2, 4, 4000))
    flat = np.zeros(4000)
    walls = [
        np.c_[u[0], v[0], flat - 1.7],
        np.c_[u[1], flat + 15, 0.2 * v[1]],
        np.c_[flat - 15, u[2], 0.2 * v[2]],
        np.c_[u[3], flat - 13, 0.2 * v[3]],
    ]
    points = np.concatenate(walls) + rng.normal(0, 0.02, (16000, 3))
    T = invert(T_room_lidar)
    return dense.coarse_cloud(points @ T[:3, :3].T + T[:3, 3], 0.5)


def test_gicp_ends_within_centimetres_from_where_lines_leave_it(rng):
    T_room_source = from_yaw(2.0, np.array([3.0, -2.0, 0.0]))
    T_room_target = from_yaw(-0.5, np.array([-1.0, 1.0, 0.1]))
    source = moving_cloud(room(rng, T_room_source))
    target = dense.prepare(room(rng, T_room_target))
    T_true = invert(T_room_target) @ T_room_source
    guess = T_true @ from_yaw(np.radians(0.5), np.array([0.15, -0.1, 0.05]))
    aligned = align_near(target, source, guess)
    off = invert(T_true) @ aligned.fit.T_target_source
    assert distance_m(off) < 0.03  # noise of 2 cm on thousands of points; voxels add a little
    assert np.degrees(rotation_angle_rad(off)) < 0.1
    assert aligned.overlap > 0.8

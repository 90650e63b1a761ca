"""Seeing through things: in front of what was seen contradicts, behind it says nothing."""

import numpy as np
import pytest

from sl3d_slam.geometry.se3 import from_yaw, invert, transform_points
from sl3d_slam.matching.visibility import Visibility, compare, range_image


def wall(x, half_width=8.0):
    """A wall across the x axis from 1.5 m below to 3 m above the sensor, dense enough for cells."""
    y, z = np.meshgrid(np.arange(-half_width, half_width, 0.1), np.arange(-1.5, 3.0, 0.1))
    return np.c_[np.full(y.size, x), y.ravel(), z.ravel()]


@pytest.fixture(scope="module")
def image():
    return range_image(wall(20.0))


def test_the_same_wall_agrees(image):
    seen = compare(image, wall(20.0), np.eye(4))
    assert seen == Visibility(len(wall(20.0)), 0)
    assert seen.share == 1.0


def test_a_wall_in_front_contradicts(image):
    nearer = 0.6 * wall(20.0)  # in the same directions
    assert compare(image, nearer, np.eye(4)) == Visibility(0, len(nearer))
    assert compare(image, nearer, np.eye(4)).share == 0.0


def test_a_wall_behind_says_nothing(image):
    assert compare(image, wall(30.0), np.eye(4)) == Visibility(0, 0)


def test_where_the_target_saw_nothing_the_source_says_nothing(image):
    behind_the_back = wall(20.0) * [-1.0, 1, 1]
    assert compare(image, behind_the_back, np.eye(4)) == Visibility(0, 0)


def test_the_margin_is_a_metre_and_4_percent(image):
    ahead = np.array([[18.3, 0.0, 0.0], [17.9, 0.0, 0.0]])  # 20 - 1 - 4 % of the point's range
    assert compare(image, ahead[:1], np.eye(4)) == Visibility(1, 0)
    assert compare(image, ahead[1:], np.eye(4)) == Visibility(0, 1)


def test_the_pose_maps_source_into_target(image):
    T_target_source = from_yaw(np.radians(130.0), np.array([9.0, 4.0, 0.2]))
    source = transform_points(invert(T_target_source), wall(20.0))
    assert compare(image, source, T_target_source).share == 1.0
    assert compare(image, source, invert(T_target_source)).agree < 0.1 * len(source)


def test_a_thick_thing_is_seen_from_its_front_to_its_back():
    image = range_image(np.concatenate([wall(15.0), wall(25.0)]))
    inside = np.array([[20.0, 0.0, 0.0]])
    assert compare(image, inside, np.eye(4)) == Visibility(1, 0)


def test_near_and_steep_points_say_nothing(image):
    near_or_steep = np.array([[2.5, 0, 0], [4.0, 0, 3.0], [4.0, 0, -3.5], [0.0, 0, 0]])
    assert compare(image, near_or_steep, np.eye(4)) == Visibility(0, 0)


def test_counts_add_up_and_silence_is_no_agreement():
    assert Visibility(3, 1) + Visibility(1, 3) == Visibility(4, 4)
    assert Visibility(4, 4).share == 0.5
    assert Visibility(0, 0).share == 0.0


def test_an_empty_cloud_is_an_image_of_nothing():
    empty = range_image(np.zeros((0, 3)))
    assert not np.isfinite(empty[:, :, 0]).any()
    assert compare(empty, wall(20.0), np.eye(4)) == Visibility(0, 0)

"""Standing lines in a levelled frame: what a tilted sensor must not change."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sl3d_slam.geometry.se3 import invert, make_transform, transform_points
from sl3d_slam.matching.verticals import find_verticals, levelling, up_of_lines
from sl3d_slam.types import LineSet

TEN_DEG = np.radians(10.0)


def line_set(endpoints, **columns):
    endpoints = np.asarray(endpoints, float).reshape(-1, 2, 3)
    count = len(endpoints)
    return LineSet(
        endpoints, np.zeros((count, 0), np.float32), np.full(count, 20, np.int64), **columns
    )


def poles(xy, low=-1.7, high=3.0):
    """Upright lines in the sensor's level frame."""
    xy = np.asarray(xy, float)
    ends = [np.column_stack([xy, np.full(len(xy), z)]) for z in (low, high)]
    return line_set(np.stack(ends, axis=1))


def tilt(roll_deg, pitch_deg):
    """``T_level_lidar`` of a sensor leaned over without being turned about the vertical."""
    up_lidar = Rotation.from_euler("xy", [roll_deg, pitch_deg], degrees=True).apply([0, 0, 1.0])
    return up_lidar


@pytest.fixture
def street(rng):
    return rng.uniform(-40, 40, (20, 2))


@pytest.mark.parametrize(("roll_deg", "pitch_deg"), [(10.0, 0.0), (0.0, -15.0), (12.0, 9.0)])
def test_a_tilted_sensor_sees_the_same_plan(street, roll_deg, pitch_deg):
    level = poles(street)
    T_lidar_level = invert(levelling(tilt(roll_deg, pitch_deg)))
    tilted = level.transformed(T_lidar_level)
    up = up_of_lines(tilted)
    np.testing.assert_allclose(up, tilt(roll_deg, pitch_deg), atol=1e-9)
    found = find_verticals(tilted, levelling(up), TEN_DEG)
    np.testing.assert_allclose(found.xy, street, atol=1e-9)
    np.testing.assert_allclose(found.heights, np.tile([-1.7, 3.0], (20, 1)), atol=1e-9)


def test_levelling_takes_up_to_z_and_maps_lidar_into_level():
    up_lidar = tilt(7.0, -4.0)
    (z,) = transform_points(levelling(up_lidar), up_lidar[None])
    np.testing.assert_allclose(z, [0.0, 0.0, 1.0], atol=1e-12)


def test_the_order_of_end_points_means_nothing(street):
    level = poles(street)
    swapped = line_set(level.endpoints[:, ::-1])
    found = [find_verticals(lines, np.eye(4), TEN_DEG) for lines in (level, swapped)]
    np.testing.assert_array_equal(found[0].xy, found[1].xy)
    np.testing.assert_array_equal(found[0].heights, found[1].heights)


def test_only_upright_lines_are_kept_and_rows_lead_back():
    leaning = [[5.0, 1.0, 0.0], [5.0 + 3 * np.tan(np.radians(11.0)), 1.0, 3.0]]
    upright = [[8.0, 2.0, 0.0], [8.0 + 3 * np.tan(np.radians(9.0)), 2.0, 3.0]]
    flat = [[0.0, 4.0, 1.0], [6.0, 4.0, 1.0]]
    lines = line_set([leaning, flat, upright], scores=np.array([0.2, 0.3, 0.4], np.float32))
    found = find_verticals(lines, np.eye(4), TEN_DEG)
    assert found.indices.tolist() == [2]
    np.testing.assert_allclose(found.weights, [0.4], rtol=1e-6)


def test_a_leaning_line_is_met_at_the_sensors_height_and_never_extended():
    # x grows by 0.1 m a metre of height; the second line ends 1 m above the sensor
    lines = line_set([[[5.0, 0, -2.0], [5.4, 0, 2.0]], [[7.0, 0, 1.0], [7.2, 0, 3.0]]])
    found = find_verticals(lines, np.eye(4), TEN_DEG)
    np.testing.assert_allclose(found.xy, [[5.2, 0.0], [7.0, 0.0]], atol=1e-12)


def test_up_follows_most_of_the_length_not_a_leaning_minority(street):
    leaning = poles(street[:6]).transformed(
        make_transform(Rotation.from_euler("x", 20, degrees=True).as_matrix(), np.zeros(3))
    )
    mixed = line_set(np.concatenate([poles(street).endpoints, leaning.endpoints]))
    np.testing.assert_allclose(up_of_lines(mixed), [0, 0, 1.0], atol=1e-9)


@pytest.mark.parametrize("endpoints", [np.zeros((0, 2, 3)), [[[0, 0, 1], [5.0, 0, 1]]]])
def test_without_upright_lines_up_is_z_and_nothing_stands(endpoints):
    lines = line_set(endpoints)
    np.testing.assert_array_equal(up_of_lines(lines), [0, 0, 1.0])
    found = find_verticals(lines, np.eye(4), TEN_DEG)
    assert len(found) == 0
    assert found.xy.shape == (0, 2)

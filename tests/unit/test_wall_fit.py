"""Planes seen from above, where they end and meet, and the cells that they are looked up in."""

import numpy as np
import pytest

from sl3d_slam.geometry.se3 import from_yaw
from sl3d_slam.lines.grid import cell_index, gathered, rows_in_square
from sl3d_slam.lines.wall_fit import connected_on_plane, fit_plane, meeting_of_walls, straight_end


def along_a_wall(rng, yaw, offset, count=200):
    """Points of a wall seen from above, noise of 1 cm; its normal has the heading ``yaw``."""
    normal = np.array([np.cos(yaw), np.sin(yaw)])
    side = np.array([-np.sin(yaw), np.cos(yaw)])
    along = rng.uniform(-1.0, 1.0, (count, 1))
    return normal, normal * offset + along * side + rng.normal(0, 0.01, (count, 1)) * normal


@pytest.mark.parametrize("yaw", [0.0, 0.7, 1.5707963, 3.0])
def test_plane_of_a_wall_whatever_hangs_on_it(rng, yaw):
    normal, plan = along_a_wall(rng, yaw, 4.0)
    signs = plan[:20] + 0.4 * normal
    found, offset = fit_plane(np.vstack([plan, signs]))
    sign = np.sign(found @ normal)
    assert sign * offset == pytest.approx(4.0, abs=0.005)  # 1 cm over the root of 200
    assert abs(found @ normal) > np.cos(np.radians(0.5))


def test_a_wall_is_followed_to_the_first_gap():
    x = np.r_[np.arange(-3.0, -1.4, 0.1), np.arange(-0.9, 2.0, 0.1), np.arange(2.6, 4.0, 0.1)]
    on_wall = np.c_[x, np.full_like(x, 2.0), np.ones_like(x)]
    points = np.vstack([on_wall, np.add(on_wall, [0.0, 0.5, 0.0])])[::-1]
    plane = np.array([0.0, 1.0]), 2.0  # along is then +x
    rows, positions = connected_on_plane(points, plane, (0.0, 0.5), (0.1, 0.4))
    np.testing.assert_allclose(positions, np.arange(-0.9, 2.0, 0.1), atol=1e-9)
    np.testing.assert_array_equal(points[rows, 0], positions)
    np.testing.assert_array_equal(points[rows, 1], 2.0)


def test_an_end_is_straight_where_slices_of_height_agree(rng):
    z = rng.uniform(0.0, 3.0, 900)
    outward = rng.uniform(-1.0, 0.0, 900)
    band = straight_end(z, outward)
    assert len(band) > 200
    assert outward[band].min() > -0.4
    # a slanted end: no three slices in ten end alike
    assert len(straight_end(z, outward + z)) == 0


@pytest.mark.parametrize("turn", [0.2, 1.1, 2.5])
def test_two_walls_meet_where_they_should(rng, turn):
    first, one = along_a_wall(rng, turn, 0.3)
    second, other = along_a_wall(rng, turn + 1.3, -0.2, 120)
    normals = np.vstack([np.tile(first, (200, 1)), np.tile(-second, (120, 1))])
    expected = np.linalg.solve([first, second], [0.3, -0.2])
    found = meeting_of_walls(normals, np.vstack([one, other]), 8, 0.5)
    np.testing.assert_allclose(found, expected, atol=0.01)
    assert np.isnan(meeting_of_walls(normals[:200], one, 8, 0.5)).all()
    assert np.isnan(meeting_of_walls(normals[:9], one[:9], 8, 0.5)).all()


def test_cells_of_a_square_hold_every_point_in_it(rng):
    points = rng.uniform(-10.0, 10.0, (3000, 3))
    order, start = cell_index(points, 0.25, 10.0)
    points = points[order]
    for place in ([0.0, 0.0], [-3.3, 8.1], [9.9, -9.9], [30.0, 0.0]):
        rows = rows_in_square(start, 10.0, 0.25, np.array(place), 1.2)
        reach = np.abs(points[:, :2] - place).max(axis=1)
        assert set(np.flatnonzero(reach <= 1.2)) <= set(rows)
        if place[0] < 10.0:
            assert reach[rows].max() <= 1.2 + 0.25


def test_groups_are_gathered_and_turned(rng):
    members = rng.normal(size=(30, 3))
    first, stop = np.array([20, 3, 5]), np.array([24, 3, 9])
    R_level_lidar = from_yaw(0.7, np.zeros(3))[:3, :3]
    expected = members[[20, 21, 22, 23, 5, 6, 7, 8]] @ R_level_lidar.T
    np.testing.assert_allclose(gathered(members, first, stop, R_level_lidar), expected)

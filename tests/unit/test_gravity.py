"""Which way is up on slopes: walls and poles tell, and where none stand the ground does."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sl3d_slam.config import LineSettings
from sl3d_slam.geometry.gravity import gravity_up
from sl3d_slam.geometry.ground import heights_above_ground, up_direction
from sl3d_slam.geometry.se3 import distance_m, from_yaw, invert, rotation_angle_rad
from sl3d_slam.geometry.segments import directions
from sl3d_slam.lines.extract import LineExtractor
from sl3d_slam.matching.verticals import up_of_lines
from sl3d_slam.matching.views import make_view
from sl3d_slam.registration import register_lines
from sl3d_slam.simulation.drive import plan_drive, simulate_drive
from sl3d_slam.simulation.roads import Road
from sl3d_slam.simulation.town import build_town
from sl3d_slam.types import LineKind, LineSet

UP = np.array([0.0, 0.0, 1.0])
WALLS = (((-30.0, 8.2), (30.0, 8.2)), ((-12.2, -9.2), (-12.2, -30.0)), ((5.0, -9.2), (30.0, -9.2)))
POLES = ((-20.0, 6.0), (3.0, -6.0), (14.0, 6.0), (22.0, -6.0))


def deg_between(a, b):
    return np.degrees(np.arccos(np.clip(a @ b, -1.0, 1.0)))


def ramp(rng, grade, walls=WALLS, poles=POLES):
    """Return points 2 cm off a ramp that rises along x, and off what stands upright on it."""
    parts = [np.c_[rng.uniform(-30, 30, (30_000, 2)), np.zeros(30_000)]]
    for begin, stop in np.array(walls).reshape(-1, 2, 2):
        share, count = rng.uniform(0, 1, (9_000, 1)), 9_000
        parts.append(np.c_[begin + share * (stop - begin), rng.uniform(0.0, 5.0, count)])
    parts += [np.c_[np.tile(pole, (300, 1)), rng.uniform(0.0, 4.0, 300)] for pole in poles]
    points = np.concatenate(parts)
    points[:, 2] += grade * points[:, 0] - 1.7
    return points + rng.normal(0.0, 0.02, points.shape)


def ups(points):
    """Return the normal of the ground and the way up that is found with it."""
    ground_up = up_direction(points)
    return ground_up, gravity_up(points, heights_above_ground(points, ground_up), ground_up)


@pytest.mark.parametrize("grade", [-0.12, 0.05, 0.12])
def test_on_a_ramp_what_stands_tells_which_way_is_up(rng, grade):
    turn = Rotation.from_euler("xyz", [3.0, -6.0, 50.0], degrees=True).as_matrix()
    ground_up, up = ups(ramp(rng, grade) @ turn.T)
    slope_deg = np.degrees(np.arctan(abs(grade)))
    assert deg_between(ground_up, turn @ UP) == pytest.approx(slope_deg, abs=0.3)
    assert deg_between(up, turn @ UP) < 0.2  # noise of 2 cm over 3 m, hundreds of times
    assert np.linalg.norm(up) == pytest.approx(1.0)


def test_on_level_ground_the_ground_has_the_word(rng):
    """Real things lean a little: that does not turn what all ground says."""
    points = ramp(rng, 0.0)
    points[:, 1] += 0.014 * points[:, 2]  # 0.8 deg
    ground_up, up = ups(points)
    np.testing.assert_array_equal(up, ground_up)


ASLANT = ((-20.0, -8.0), (20.0, 24.0))


@pytest.mark.parametrize(("walls", "poles"), [((), ()), ((), POLES[:1]), ((ASLANT,), ())])
def test_where_too_little_stands_the_ground_is_all_there_is(rng, walls, poles):
    """A wall alone says nothing of the lean along it."""
    ground_up, up = ups(ramp(rng, 0.1, walls, poles))
    np.testing.assert_array_equal(up, ground_up)


def test_hedges_that_lean_this_way_and_that_say_nothing(rng):
    """Whatever way most of them lean: of 1500 some always agree."""
    points = [ramp(rng, 0.0, (), ())]
    for x, y in rng.uniform(-28, 28, (1500, 2)):
        lean, z = rng.uniform(-0.05, 0.45, 2), rng.uniform(0.0, 2.5, (200, 1))
        side = rng.uniform(-0.5, 0.5, (200, 1)) * [1.0, 0.0]
        points.append(np.c_[np.array([x, y]) + side + z * lean, z - 1.7])
    ground_up, up = ups(np.concatenate(points))
    np.testing.assert_array_equal(up, ground_up)


@pytest.fixture(scope="module")
def crest():
    """A street over a hill: grades of 10 % turn by 20 % within 45 m."""
    x = np.arange(0.0, 160.0, 2.0)
    path = np.column_stack([x, 0 * x, 2.0 * np.cos(2 * np.pi * (x - 80.0) / 90.0), 0 * x])
    return plan_drive(build_town(Road("crest", path), seed=3))


@pytest.fixture(scope="module")
def either_side(crest):
    """Two scans, 30 m apart, either side of the crest, their lines, ups and ``T_target_source``."""
    turn = from_yaw(2.0, np.zeros(3))
    T_town = crest.T_town_lidar[[32, 47]] @ np.array([invert(turn), np.eye(4)])
    source, target = (scan.points_lidar for scan in simulate_drive(crest, [32, 47]))
    scans = source @ turn[:3, :3].T, target
    lines = [LineExtractor(LineSettings(method="geometric")).extract(scan) for scan in scans]
    return scans, lines, T_town[:, 2, :3], invert(T_town[1]) @ T_town[0]


def test_lines_know_which_way_is_up_either_side_of_a_crest(either_side):
    scans, lines, truth, _ = either_side
    for scan, found, up in zip(scans, lines, truth, strict=True):
        assert deg_between(found.ground_up, up) > 3.0
        assert deg_between(found.up, up) < 0.3
        np.testing.assert_array_equal(make_view(scan, found, 0.5).up, found.up)
        np.testing.assert_array_equal(up_of_lines(found), found.up)
        edges = directions(found.endpoints[found.kinds == LineKind.VERTICAL_EDGE])
        assert np.abs(edges @ up).min() > np.cos(np.radians(0.3))


def test_lines_alone_rise_by_the_mean_of_the_slopes_at_both_ends(rng):
    """That is how much a parabola rises between two places, whichever way each sensor looks."""
    T_target_source = from_yaw(2.0, np.array([15.0, 0.0, 0.11 * 15.0 - 0.005 * 15.0**2]))
    foot = np.c_[rng.uniform(-30.0, 30.0, (12, 2)), np.full(12, -1.0)]
    poles = LineSet(
        np.stack([foot, foot + 4.0 * UP], axis=1), np.zeros((12, 0), np.float32), np.ones(12, int)
    )
    normals = [np.array([-grade, 0.0, 1.0]) for grade in (0.11 - 0.01 * 15.0, 0.11)]
    ground_up = [normal / np.linalg.norm(normal) for normal in normals]
    T_source_target = invert(T_target_source)
    source = replace(poles.transformed(T_source_target), up=UP)
    source = replace(source, ground_up=T_source_target[:3, :3] @ ground_up[0])
    result = register_lines(source, replace(poles, up=UP, ground_up=ground_up[1]))
    assert result.success, result.reason
    np.testing.assert_allclose(result.T_target_source, T_target_source, atol=1e-3)
    by_one = register_lines(source, replace(poles, up=UP))
    assert by_one.T_target_source[2, 3] == pytest.approx((0.11 - 0.01 * 15.0) * 15.0)


@pytest.mark.parametrize(("by_lines_alone", "within"), [(False, (0.1, 0.5)), (True, (0.5, 1.5))])
def test_two_scans_register_across_a_crest(either_side, by_lines_alone, within):
    """Their grounds differ by 9 deg. Lines alone take the height from the slopes at both ends."""
    scans, lines, _, T_target_source = either_side
    result = register_lines(*lines, clouds=None if by_lines_alone else scans)
    assert result.success, result.reason
    off = invert(T_target_source) @ result.T_target_source
    assert distance_m(off) < within[0]
    assert np.degrees(rotation_angle_rad(off)) < within[1]


def test_ups_turn_with_lines_and_stay_with_some_of_them(either_side):
    _, (lines, _), _, _ = either_side
    T = from_yaw(1.0, np.array([3.0, 4.0, 5.0]))
    moved = lines.take(np.arange(3)).transformed(T)
    np.testing.assert_allclose(moved.up, T[:3, :3] @ lines.up)
    np.testing.assert_allclose(moved.ground_up, T[:3, :3] @ lines.ground_up)


def test_a_cloud_says_where_the_ground_is_where_lines_do_not(either_side):
    (scan, _), (lines, _), _, _ = either_side
    bare = LineSet(lines.endpoints, lines.descriptors, lines.num_points)
    assert deg_between(make_view(scan, bare, 0.5).up, lines.ground_up) < 0.3

"""Poses from matched lines: exact ones are recovered, and what no line fixes stays free."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sl3d_slam.geometry.se3 import exp, invert, log, make_transform, transform_points
from sl3d_slam.geometry.segments import directions, midpoints
from sl3d_slam.matching.solve import (
    LINE_SIGMA_M,
    fill_free,
    line_distances_m,
    line_information,
    refine_on_lines,
)
from sl3d_slam.types import LineSet

T_TRUE = make_transform(
    Rotation.from_euler("zyx", [137.0, 4.0, -3.0], degrees=True).as_matrix(),
    np.array([12.0, -7.5, 1.2]),
)
NUDGE = exp(np.array([0.01, -0.02, 0.03, 0.2, -0.15, 0.1]))
Z = 5  # translations come after rotations


def line_set(endpoints):
    count = len(endpoints)
    return LineSet(endpoints, np.zeros((count, 0), np.float32), np.full(count, 20, np.int64))


def poles(rng, count, reach_m=30.0):
    xy = rng.uniform(-reach_m, reach_m, (count, 2))
    low, high = rng.uniform(-1.7, -1.0, count), rng.uniform(1.5, 4.0, count)
    return np.stack([np.column_stack([xy, low]), np.column_stack([xy, high])], axis=1)


def any_lines(rng, count):
    """Poles, eaves and slanted lines alike."""
    middle = rng.uniform(-25, 25, (count, 3))
    axis = rng.normal(size=(count, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    half = rng.uniform(0.5, 3.0, (count, 1))
    return np.stack([middle - half * axis, middle + half * axis], axis=1)


def seen_from(T_target_source, target_endpoints, rng):
    """The target's lines in the source frame: other parts of them, other order of end points."""
    axes, middles = directions(target_endpoints), midpoints(target_endpoints)
    ends = rng.uniform(0.3, 2.5, (len(axes), 2)) * np.array([-1, 1])
    parts = middles[:, None] + ends[:, :, None] * axes[:, None]
    flip = rng.random(len(axes)) < 0.5
    parts[flip] = parts[flip, ::-1]
    flat = transform_points(invert(T_target_source), parts.reshape(-1, 3))
    return line_set(flat.reshape(-1, 2, 3))


def pairs(count):
    return np.column_stack([np.arange(count), np.arange(count)])


def test_the_pose_of_lines_in_all_directions_is_exact(rng):
    target = any_lines(rng, 20)
    source = seen_from(T_TRUE, target, rng)
    T, information = refine_on_lines(source, line_set(target), pairs(20), T_TRUE @ NUDGE)
    assert np.abs(log(invert(T_TRUE) @ T)).max() < 1e-6
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0, abs=1e-12)
    assert np.linalg.matrix_rank(information) == 6
    assert line_distances_m(source, line_set(target), pairs(20), T).max() < 1e-6


def test_wrong_matches_hardly_pull(rng):
    target = any_lines(rng, 40)
    source = seen_from(T_TRUE, target, rng)
    matches = pairs(40)
    matches[:8, 1] = np.roll(matches[:8, 1], 1)  # 20 % wrong, most of them metres away
    T, _ = refine_on_lines(source, line_set(target), matches, T_TRUE @ NUDGE)
    assert np.abs(log(invert(T_TRUE) @ T)).max() < 0.01


@pytest.mark.parametrize("reach_m", [15.0, 30.0, 55.0])
def test_poles_fix_the_plan_and_leave_the_height_alone(rng, reach_m):
    """However far away they stand: metres and radians must not be weighed against each other."""
    level = make_transform(T_TRUE[:3, :3], T_TRUE[:3, 3])
    target = poles(rng, 12, reach_m)
    source = seen_from(level, target, rng)
    T, information = refine_on_lines(source, line_set(target), pairs(12), level @ NUDGE)
    moved = invert(level) @ T
    up_source = T[2, :3]  # the target's z axis in the source frame
    shift = moved[:3, 3] - up_source * (up_source @ moved[:3, 3])
    assert np.linalg.norm(shift) < 1e-3
    assert np.linalg.norm(information @ np.r_[np.zeros(3), up_source]) < 1e-3
    for axis in np.linalg.svd(up_source[None])[2][1:]:  # both directions across the poles
        assert np.linalg.norm(information @ np.r_[np.zeros(3), axis]) > 1.0


def numeric_information(source, target, T):
    """Gauss-Newton by finite differences of the end points' distances, steps on the right."""
    axes, middles = directions(target.endpoints), midpoints(target.endpoints)

    def residuals(xi):
        moved = transform_points(T @ exp(xi), source.endpoints.reshape(-1, 3)).reshape(-1, 2, 3)
        offset = moved - middles[:, None]
        along = (offset * axes[:, None]).sum(axis=2, keepdims=True)
        return (offset - along * axes[:, None]).ravel()

    step = 1e-6
    J = np.stack([(residuals(step * e) - residuals(-step * e)) / (2 * step) for e in np.eye(6)], 1)
    return J.T @ J / LINE_SIGMA_M**2


def test_information_is_that_of_a_step_on_the_right_rotation_first(rng):
    target = any_lines(rng, 20)
    source = seen_from(T_TRUE, target, rng)
    _, information = refine_on_lines(source, line_set(target), pairs(20), T_TRUE)
    expected = numeric_information(source, line_set(target), T_TRUE)
    np.testing.assert_allclose(information, expected, rtol=1e-5, atol=1e-5 * expected.max())


def test_upright_poles_inform_roll_and_pitch_by_their_lengths_and_z_not_at_all(rng):
    target = poles(rng, 10, reach_m=15.0)
    source = line_set(target)
    _, information = refine_on_lines(source, line_set(target), pairs(10), np.eye(4))
    expected = numeric_information(source, line_set(target), np.eye(4))
    assert np.linalg.matrix_rank(information) == 5
    np.testing.assert_allclose(information, expected, rtol=1e-5, atol=1e-5 * expected.max())
    np.testing.assert_allclose(information[Z], 0.0, atol=1e-6)
    np.testing.assert_allclose(information[:, Z], 0.0, atol=1e-6)


def test_one_pole_leaves_height_and_the_turn_about_itself_free():
    target = line_set(np.array([[[4.0, -3.0, -1.5], [4.0, -3.0, 3.0]]]))
    _, information = refine_on_lines(target, target, pairs(1), np.eye(4))
    assert np.linalg.matrix_rank(information) == 4
    about_the_pole = np.array([0, 0, 1.0, -3.0, -4.0, 0])  # omega = z, v = -z x p
    np.testing.assert_allclose(information @ about_the_pole, 0.0, atol=1e-6)


def test_without_matches_nothing_moves_and_nothing_is_known(rng):
    lines = line_set(any_lines(rng, 3))
    T, information = refine_on_lines(lines, lines, np.zeros((0, 2), np.int64), T_TRUE)
    np.testing.assert_allclose(T, T_TRUE, atol=1e-12)
    assert not information.any()


def test_ways_up_keep_a_few_short_lines_from_tipping_a_pose(rng):
    xy = rng.uniform(-4.0, 4.0, (5, 1, 2))
    target = np.concatenate([np.tile(xy, (1, 2, 1)), np.tile([[[-1.0], [1.0]]], (5, 1, 1))], axis=2)
    leaning = target + np.array([[-0.075, 0.0, 0.0], [0.075, 0.0, 0.0]])  # each by 4.3 degrees
    source = line_set(transform_points(invert(T_TRUE), leaning.reshape(-1, 3)).reshape(-1, 2, 3))
    up_target = np.array([0.0, 0.0, 1.0])
    ups = T_TRUE[:3, :3].T @ up_target, up_target

    def tipped_deg(T):
        return np.degrees(np.arccos((T[:3, :3] @ ups[0]) @ up_target))

    free, of_lines = refine_on_lines(source, line_set(target), pairs(5), T_TRUE @ NUDGE)
    held, information = refine_on_lines(source, line_set(target), pairs(5), T_TRUE @ NUDGE, ups)
    assert tipped_deg(free) > 3.0
    assert tipped_deg(held) < 1.0
    shift = (held @ invert(T_TRUE))[:2, 3]
    assert np.linalg.norm(shift) < 0.2
    # what is known of the pose is still only what the lines say
    np.testing.assert_allclose(information, of_lines, rtol=0.2, atol=0.05 * of_lines.max())


def test_line_distance_ignores_where_along_the_line():
    target = line_set(np.array([[[0.0, 0, 0], [0, 0, 2.0]]]))
    source = line_set(np.array([[[0.3, 0.4, 50.0], [0.0, 0.0, -9.0]]]))
    np.testing.assert_allclose(
        line_distances_m(source, target, pairs(1), np.eye(4)), [0.25], atol=1e-12
    )


def test_information_at_a_pose_is_that_of_the_refined_one(rng):
    target = any_lines(rng, 20)
    source = seen_from(T_TRUE, target, rng)
    _, refined = refine_on_lines(source, line_set(target), pairs(20), T_TRUE)
    given = line_information(source, line_set(target), pairs(20), T_TRUE)
    np.testing.assert_allclose(given, refined, rtol=1e-6, atol=1e-6 * refined.max())


def test_lines_fill_only_what_clouds_leave_free(rng):
    """A corridor holds all but the way along it; poles know that way."""
    along = np.array([0.0, 0.0, 0.0, 0.6, 0.8, 0.0])
    across = np.eye(6) - np.outer(along, along)
    corridor = across @ np.diag([4e6, 4e6, 9e6, 9e3, 9e3, 9e3]) @ across
    poles_say = np.diag([0.0, 0.0, 5e4, 300.0, 300.0, 0.0])
    filled = fill_free(corridor, poles_say)
    assert np.linalg.matrix_rank(corridor) == 5
    assert np.linalg.matrix_rank(filled) == 6
    assert along @ filled @ along == pytest.approx(300.0)
    held = np.linalg.svd(along[None])[2][1:]
    np.testing.assert_allclose(held @ filled @ held.T, held @ corridor @ held.T, rtol=1e-6)
    np.testing.assert_array_equal(
        fill_free(np.diag(np.arange(1.0, 7.0)), poles_say).diagonal(), np.arange(1.0, 7.0)
    )
    assert np.linalg.matrix_rank(fill_free(corridor, np.zeros((6, 6)))) == 5

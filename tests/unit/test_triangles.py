"""Triangles of standing lines: what no change of view alters, and what a mirror does."""

import numpy as np
import pytest

from sl3d_slam.loops.triangles import (
    all_triangles,
    local_triangles,
    sides_m,
    turns_left,
)

YAW, SHIFT = np.radians(137.0), np.array([31.0, -12.0])


def move(xy):
    c, s = np.cos(YAW), np.sin(YAW)
    return xy @ np.array([[c, -s], [s, c]]).T + SHIFT


def shapes(xy, triangles):
    """Each triangle as its sides, its sense and its corners' places, in no order."""
    found = set()
    for i, j, k in triangles:
        sides = tuple(np.round(sides_m(xy, i, j, k), 6))
        found.add((*sides, turns_left(xy, i, j, k)))
    return found


@pytest.fixture
def lines(rng):
    return rng.uniform(-30, 30, (14, 2))


@pytest.mark.parametrize(
    "find", [lambda xy: local_triangles(xy, 6), lambda xy: all_triangles(xy, 0.0)]
)
def test_triangles_are_the_same_from_everywhere_and_in_any_order(lines, rng, find):
    seen = shapes(lines, find(lines))
    assert len(seen) > 20
    assert shapes(move(lines), find(move(lines))) == seen
    shuffled = lines[rng.permutation(len(lines))]
    assert shapes(shuffled, find(shuffled)) == seen


def test_a_mirror_image_has_the_same_sides_and_the_other_sense(lines):
    seen = shapes(lines, all_triangles(lines, 0.0))
    mirrored = lines * [1.0, -1.0]
    reflected = shapes(mirrored, all_triangles(mirrored, 0.0))
    assert not seen & reflected
    assert {(a, b, c, 1 - left) for a, b, c, left in reflected} == seen


def test_sides_run_from_long_to_short_and_stay_in_range(lines):
    for i, j, k in all_triangles(lines, 0.0):
        a, b, c = sides_m(lines, i, j, k)
        assert 40.0 >= a >= b >= c >= 3.0
        assert a + b + c >= 2.03 * a


def test_one_triangle_by_hand():
    xy = np.array([[0.0, 0.0], [0.0, 6.0], [8.0, 0.0]])  # sides 6, 8 and 10
    assert sides_m(xy, 0, 1, 2) == (10.0, 8.0, 6.0)  # opposite the corners
    assert turns_left(xy, 0, 1, 2) == 0
    assert all_triangles(xy, 0.0).tolist() == [[0, 1, 2]]
    assert local_triangles(xy, 9).tolist() == [[0, 1, 2]]


def test_nearly_equal_sides_give_every_order_they_allow():
    xy = np.array([[0.0, 0.0], [10.0, 0.0], [5.0, 8.7]])  # sides 10, 10.03, 10.03
    assert len(all_triangles(xy, 0.35)) == 6
    assert len(local_triangles(xy, 2, 0.35)) == 6
    assert len(all_triangles(np.array([[0.0, 0.0], [0.0, 6.0], [8.0, 0.0]]), 0.35)) == 1


def test_local_triangles_are_those_of_a_line_and_two_of_its_nearest():
    near = np.array([[0.0, 0.0], [5.0, 0.0], [0.0, 6.0]])
    xy = np.concatenate([near, np.add(near, [20.0, 21.0])])  # two groups of three, 25 m apart
    found = {tuple(sorted(corners)) for corners in local_triangles(xy, 2).tolist()}
    assert found == {(0, 1, 2), (3, 4, 5)}
    assert len(all_triangles(xy, 0.0)) > 10
    # whoever has enough neighbours has every triangle, in every order
    assert shapes(xy, local_triangles(xy, 5, 0.35)) == shapes(xy, all_triangles(xy, 0.35))


@pytest.mark.parametrize(
    "xy",
    [
        np.zeros((0, 2)),
        np.array([[0.0, 0], [5, 0]]),
        np.array([[0.0, 0], [5, 0], [12, 0.1]]),  # a sliver
        np.array([[0.0, 0], [2, 0], [5, 5]]),  # two lines of one thing
        np.array([[0.0, 0], [41, 0], [20, 20]]),  # too wide to be seen together
    ],
)
def test_useless_triangles_are_left_out(xy):
    assert len(all_triangles(xy, 0.0)) == 0
    assert len(local_triangles(xy, 9)) == 0

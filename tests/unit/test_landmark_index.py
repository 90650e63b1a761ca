"""Finding a constellation in a whole map: exact poses, bounded work, and mirror images."""

import numpy as np
import pytest

from sl3d_slam.loops import landmark_index
from sl3d_slam.loops.landmark_index import LandmarkIndex
from sl3d_slam.loops.landmark_triangles import unique_triads
from sl3d_slam.loops.triangles import local_triangles

NUM_NEAR = 30


def neighbourhoods(xy, centres):
    """What a sensor at each centre sees: the nearest lines, strongest first is nearest first."""
    rows = [np.argsort(np.hypot(*(xy - centre).T), kind="stable")[:NUM_NEAR] for centre in centres]
    return np.array(rows, np.int32)


@pytest.fixture(scope="module")
def world():
    rng = np.random.default_rng(5)
    xy = rng.uniform(0, 300, (900, 2))
    grid = np.arange(10, 300, 20.0)
    centres = np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2)
    return xy, LandmarkIndex(xy, neighbourhoods(xy, centres))


def seen_from(xy, pose, noise_m=0.0, keep=NUM_NEAR):
    """Lines around a pose in the sensor's frame: ``p_sensor = R(yaw)^T (p_map - t)``."""
    yaw, x, y = pose
    c, s = np.cos(yaw), np.sin(yaw)
    moved = (xy - [x, y]) @ np.array([[c, -s], [s, c]])
    nearest = np.argsort(np.hypot(*moved.T), kind="stable")[:keep]
    noise = np.random.default_rng(1).normal(0, noise_m, (keep, 2))
    return moved[nearest] + noise


@pytest.mark.parametrize("pose", [(2.0, 70.0, 110.0), (-3.1, 205.0, 190.0), (0.4, 150.0, 60.0)])
def test_the_best_votes_are_for_the_true_pose(world, pose):
    xy, index = world
    seen = seen_from(xy, pose, noise_m=0.05)
    found = index.query(seen, np.ones(len(seen)), 5)
    yaw_error = np.angle(np.exp(1j * (found[0, 0] - pose[0])))
    assert abs(yaw_error) < np.radians(2.0)  # 5 cm over sides of 3 m and more, many averaged
    np.testing.assert_allclose(found[0, 1:3], pose[1:], atol=0.3)
    assert found[0, 3] > 2 * found[found[:, 3] < found[0, 3]][:, 3].max(initial=0.0) or (
        np.hypot(*(found[1, 1:3] - found[0, 1:3])) < 2.0  # the same place from the next cell
    )


def test_half_of_the_lines_and_as_many_strange_ones_are_enough(world):
    xy, index = world
    rng = np.random.default_rng(8)
    pose = (1.0, 130.0, 170.0)
    seen = seen_from(xy, pose, noise_m=0.05)[::2]
    strange = rng.uniform(-30, 30, (len(seen), 2))
    found = index.query(np.concatenate([seen, strange]), np.ones(2 * len(seen)), 3)
    np.testing.assert_allclose(found[0, 1:3], pose[1:], atol=0.4)


def test_a_mirror_image_is_not_taken_for_the_place(world):
    xy, index = world
    seen = seen_from(xy, (0.5, 150.0, 150.0))
    true_votes = index.query(seen, np.ones(len(seen)), 1)[0, 3]
    mirrored = index.query(seen * [1.0, -1.0], np.ones(len(seen)), 1)
    assert len(mirrored) == 0 or mirrored[0, 3] < 0.2 * true_votes


def test_each_triangle_of_overlapping_neighbourhoods_is_stored_once(world):
    xy, _ = world
    near = neighbourhoods(xy, [[150.0, 150.0]])
    once, again = LandmarkIndex(xy, near), LandmarkIndex(xy, np.tile(near, (3, 1)))
    assert len(once) == len(again) > 100


def test_a_budget_tries_the_rarest_triangles_first_and_still_finds(world, monkeypatch):
    xy, index = world
    monkeypatch.setattr(landmark_index, "MAX_COMPARISONS", 20_000)  # of some 400,000
    pose = (2.0, 70.0, 110.0)
    seen = seen_from(xy, pose, noise_m=0.05)
    found = index.query(seen, np.ones(len(seen)), 1)
    np.testing.assert_allclose(found[0, 1:3], pose[1:], atol=0.3)


def test_nothing_is_found_with_two_lines_or_in_an_empty_map(world):
    _, index = world
    two = np.array([[0.0, 5.0], [9.0, 0.0]])
    assert index.query(two, np.ones(2), 5).shape == (0, 4)
    empty = LandmarkIndex(np.zeros((0, 2)), np.zeros((0, 40), np.int32))
    many = np.random.default_rng(0).uniform(-30, 30, (20, 2))
    assert empty.query(many, np.ones(20), 5).shape == (0, 4)


def test_the_index_stores_the_triangles_of_each_neighbourhood_and_no_others(world):
    """Against the slow way: triangles of one neighbourhood at a time, joined in a set."""
    xy, _ = world
    rows = neighbourhoods(xy, [[100.0, 100.0], [108.0, 104.0], [250.0, 40.0]])
    rows[1, 20:] = -1
    expected = set()
    for members in rows:
        members = members[members >= 0]
        expected |= set(map(tuple, members[local_triangles(xy[members], 9)].tolist()))
    stored = unique_triads(xy, rows, 9).tolist()
    assert len(stored) == len(expected)
    assert set(map(tuple, stored)) == expected

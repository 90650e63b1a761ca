"""Places by constellation: one planted revisit among two hundred strangers."""

import numpy as np
import pytest

from sl3d_slam.loops.constellations import MAX_LINES, ConstellationIndex

NUM_VIEWS, PLANTED = 200, 77
POSE = np.array([np.radians(-160.0), 9.0, -5.0])  # of the query in the view: the other way round


def move_back(pose, xy):
    c, s = np.cos(pose[0]), np.sin(pose[0])
    return (xy - pose[1:]) @ np.array([[c, -s], [s, c]])


def stranger(rng, count=16):
    return rng.uniform(-35, 35, (count, 2))


def revisit(rng, xy, num_shared=10, num_new=6, noise_m=0.05):
    """Some of a view's lines from a new pose, and others that were not there."""
    shared = rng.permutation(len(xy))[:num_shared]
    seen = move_back(POSE, xy[shared] + rng.normal(0, noise_m, (num_shared, 2)))
    both = np.concatenate([seen, stranger(rng, num_new)])
    return both[rng.permutation(len(both))]


@pytest.fixture(scope="module")
def town():
    rng = np.random.default_rng(5)
    views = [stranger(rng) for _ in range(NUM_VIEWS)]
    index = ConstellationIndex()
    for view_id, xy in enumerate(views):
        index.add(view_id, xy, np.ones(len(xy)))
    return index, views


def ask(index, xy, newest=NUM_VIEWS, limit=5):
    return index.query(xy, np.ones(len(xy)), newest, limit)


@pytest.mark.parametrize("seed", range(5))
def test_the_revisit_wins_and_its_pose_maps_the_query_into_the_view(town, seed):
    index, views = town
    best, *others = ask(index, revisit(np.random.default_rng(seed), views[PLANTED]))
    assert best.view_id == PLANTED
    assert best.votes > 2 * max(other.votes for other in others)
    # the mean of many triangles with 5 cm of noise
    assert abs(np.angle(np.exp(1j * (best.pose[0] - POSE[0])))) < 0.02
    np.testing.assert_allclose(best.pose[1:], POSE[1:], atol=0.3)


def test_views_newer_than_asked_for_take_no_part(town):
    index, views = town
    query = revisit(np.random.default_rng(0), views[PLANTED])
    assert {vote.view_id for vote in ask(index, query, newest=PLANTED - 1)} <= set(range(PLANTED))
    assert ask(index, query, newest=PLANTED)[0].view_id == PLANTED
    assert ask(index, query, newest=-1) == []


def test_votes_come_best_first_one_a_view_and_no_more_than_asked_for(town):
    index, views = town
    votes = ask(index, revisit(np.random.default_rng(1), views[PLANTED]), limit=7)
    assert len(votes) <= 7
    assert [v.votes for v in votes] == sorted((v.votes for v in votes), reverse=True)
    assert len({v.view_id for v in votes}) == len(votes)


def test_a_mirror_image_is_another_place(town):
    index, views = town
    votes = ask(index, views[PLANTED] * [1.0, -1.0])
    itself = ask(index, views[PLANTED])[0]
    assert max((v.votes for v in votes), default=0) < 0.2 * itself.votes


def test_the_order_of_lines_means_nothing(town):
    index, views = town
    query = revisit(np.random.default_rng(2), views[PLANTED])
    first, second = ask(index, query, limit=1)[0], ask(index, query[::-1].copy(), limit=1)[0]
    assert (first.view_id, first.votes) == (second.view_id, second.votes)
    np.testing.assert_allclose(first.pose, second.pose, atol=1e-9)


def test_only_the_strongest_lines_take_part(rng):
    strong, weak = stranger(rng, MAX_LINES), stranger(rng, 20)
    weights = np.r_[np.ones(MAX_LINES), np.full(20, 0.1)]
    alone, crowded = ConstellationIndex(), ConstellationIndex()
    alone.add(0, strong, np.ones(MAX_LINES))
    crowded.add(0, np.concatenate([strong, weak]), weights)
    assert len(alone) == len(crowded) > 0


def test_thousands_of_triangles_survive_the_growth_of_the_table(rng):
    index, first = ConstellationIndex(), stranger(rng, 30)
    index.add(0, first, np.ones(30))
    before = ask(index, first, limit=1)
    for view_id in range(1, 30):
        index.add(view_id, stranger(rng, 30), np.ones(30))
    assert len(index) > 2 * 4096
    assert ask(index, first, newest=0, limit=1) == before


@pytest.mark.parametrize("count", [0, 1, 2])
def test_too_few_lines_find_nothing_and_leave_nothing(town, rng, count):
    index, _ = town
    assert ask(index, stranger(rng, count)) == []
    empty = ConstellationIndex()
    empty.add(0, stranger(rng, count), np.ones(count))
    assert len(empty) == 0
    assert ask(empty, stranger(rng)) == []

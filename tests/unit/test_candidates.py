"""Which earlier views are worth verifying."""

import numpy as np
import pytest

from sl3d_slam.config import LoopSettings
from sl3d_slam.geometry.se3 import from_yaw, invert
from sl3d_slam.loops.candidates import is_worth_a_loop, nearest_by_estimate, thin_votes
from sl3d_slam.loops.constellations import PlaceVote

SETTINGS = LoopSettings(max_candidates=2, min_votes=6, nearby_m=12.0)


def vote(view_id, votes):
    return PlaceVote(view_id, (0.0, 0.0, 0.0), float(votes))


def test_one_vote_a_place_best_first_and_no_more_than_the_limit():
    votes = [vote(3, 40), vote(4, 30), vote(20, 20), vote(40, 10)]
    travelled_m = {k: 5.0 * k for k in range(50)}
    assert [v.view_id for v in thin_votes(votes, travelled_m, SETTINGS)] == [3, 20]


def test_weak_votes_are_no_candidates_and_15_m_are_another_place():
    travelled_m = {0: 0.0, 1: 14.9, 2: 15.0, 3: 60.0}
    votes = [vote(0, 9), vote(1, 8), vote(2, 7), vote(3, 5)]
    assert [v.view_id for v in thin_votes(votes, travelled_m, SETTINGS)] == [0, 2]
    assert thin_votes([], travelled_m, SETTINGS) == []


@pytest.mark.parametrize(
    ("distance_m", "drift_m", "worth"),
    [
        (0.0, 0.01, True),
        (20.0, 0.5, True),  # off by 0.2 m at worst
        (20.0, 0.3, False),
        (59.0, 1.3, True),
        (59.0, 1.1, False),
        (61.0, 1000.0, False),  # hardly anything is seen from both
    ],
)
def test_far_views_are_worth_a_loop_where_odometry_is_much_less_certain(distance_m, drift_m, worth):
    assert is_worth_a_loop(distance_m, drift_m, SETTINGS) == worth


def world(gap_m):
    """Three old views along x and a query beside the second one."""
    estimates = {k: from_yaw(0.4, np.array([10.0 * k, 0.0, 0.0])) for k in range(3)}
    estimates[9] = from_yaw(2.0, np.array([10.0, gap_m, 3.0]))
    return estimates


def test_the_nearest_view_comes_with_the_estimate_from_view_to_query():
    estimates = world(8.0)
    found = nearest_by_estimate(9, 2, estimates, {0: 0.0, 1: 10.0, 2: 20.0, 9: 20.0}, SETTINGS)
    assert found.view_id == 1
    np.testing.assert_allclose(found.T_view_query, invert(estimates[1]) @ estimates[9])


@pytest.mark.parametrize(
    ("gap_m", "travelled_m", "found"),
    [
        (11.9, 10.0, True),  # no travel between: 12 m
        (12.1, 10.0, False),
        (15.9, 210.0, True),  # 200 m of travel may have drifted by 4 m
        (16.1, 210.0, False),
        (23.9, 5000.0, True),  # and never by more than another 12 m
        (24.1, 5000.0, False),
    ],
)
def test_the_reach_grows_with_drift_up_to_twice(gap_m, travelled_m, found):
    travelled = {0: 0.0, 1: 10.0, 2: 20.0, 9: travelled_m}
    nearest = nearest_by_estimate(9, 2, world(gap_m), travelled, SETTINGS)
    assert (nearest is not None) == found


def test_views_too_new_to_be_a_revisit_are_left_out():
    estimates = world(1.0)
    travelled = {0: 0.0, 1: 10.0, 2: 20.0, 9: 25.0}
    assert nearest_by_estimate(9, 0, estimates, travelled, SETTINGS).view_id == 0
    assert nearest_by_estimate(9, -1, estimates, travelled, SETTINGS) is None

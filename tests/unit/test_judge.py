"""What counts against a refined pose, and that a no never carries one."""

from dataclasses import replace

import numpy as np
import pytest

from sl3d_slam.config import LoopSettings, MatchingSettings
from sl3d_slam.geometry.se3 import from_yaw, invert, make_transform, rotation_between
from sl3d_slam.matching.judge import (
    Evidence,
    likeness,
    matched_lines,
    objection,
    refusal,
    to_registration,
)
from sl3d_slam.matching.prepared import PreparedView, flatten, lift
from sl3d_slam.matching.views import make_view, pack, unpack, view_of_lines
from sl3d_slam.matching.visibility import Visibility
from sl3d_slam.types import LineSet, View

SETTINGS = MatchingSettings()
GOOD = Evidence(
    T_target_source=from_yaw(2.0, np.array([3.0, -1.0, 0.2])),
    information=np.diag([1e6] * 3 + [1e4] * 3).astype(float),
    correction_m=0.3,
    correction_rad=0.02,
    overlap=0.6,
    seen=Visibility(agree=3000, contradict=150),
    matches=np.column_stack([np.arange(7), np.arange(7)[::-1]]),
    likeness=10.0,
    misfit=0.14,
)
SLIDING = np.diag([1e6, 1e6, 1e6, 0.0, 1e4, 1e4])


def test_good_evidence_is_not_objected_to_and_becomes_an_answer():
    assert objection(GOOD, SETTINGS) == ""
    result = to_registration(GOOD, "")
    assert result.success
    assert result.T_target_source is GOOD.T_target_source
    assert (result.num_inliers, result.overlap) == (7, 0.6)


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"correction_m": 4.1}, "refinement left the guess by 4.1 m"),
        ({"correction_rad": np.radians(11.0)}, "refinement left the guess"),
        ({"overlap": 0.02}, "2% of the clouds overlap"),
        ({"seen": Visibility(3000, 900)}, "sees through 23%"),
        ({"likeness": 0.5}, "7 lines agree"),
        ({"misfit": 0.3}, "7 lines agree"),
        ({"seen": Visibility(0, 0)}, "sees through"),
        ({"seen": Visibility(299, 0)}, "only 299 points agree"),
        ({"matches": GOOD.matches[:2]}, "only 2 lines agree"),
        ({"information": SLIDING}, "may slide"),
    ],
)
def test_each_weakness_is_named_and_leaves_no_pose(change, word):
    reason = objection(replace(GOOD, **change), SETTINGS)
    assert word in reason
    result = to_registration(replace(GOOD, **change), reason)
    assert not result.success
    assert result.T_target_source is None
    assert not result.information.any()
    assert result.reason == reason


def test_a_loop_whose_pose_had_no_rivals_needs_more_than_a_pair_does():
    unsure = replace(GOOD, overlap=0.09)
    assert objection(unsure, SETTINGS) == ""
    needed = LoopSettings().judging(SETTINGS)
    assert "9% of the clouds overlap" in objection(unsure, needed)
    assert needed.inlier_distance_m == SETTINGS.inlier_distance_m


def test_a_refusal_has_a_reason_and_nothing_else():
    result = refusal("nothing there")
    assert (result.success, result.T_target_source, result.num_inliers) == (False, None, 0)
    assert result.matches.shape == (0, 2)
    assert result.reason == "nothing there"


def test_odds_rise_with_likeness_agreement_and_lead_fall_with_misfit_and_stay_finite():
    odds = GOOD.log_odds
    assert replace(GOOD, likeness=5.0).log_odds < odds
    assert replace(GOOD, misfit=0.2).log_odds < odds
    assert replace(GOOD, seen=Visibility(3000, 300)).log_odds < odds
    assert replace(GOOD, seen=Visibility(6000, 300)).log_odds == pytest.approx(odds)  # shares count
    assert replace(GOOD, lead=0.4).log_odds > odds > replace(GOOD, lead=-0.4).log_odds
    extremes = [Visibility(5000, 0), Visibility(0, 5000), Visibility(0, 0)]
    assert np.isfinite([replace(GOOD, seen=seen).log_odds for seen in extremes]).all()


def described(descriptors):
    """Lines of which only the descriptors matter."""
    count = len(descriptors)
    rows = np.asarray(descriptors, np.float32)
    return LineSet(np.zeros((count, 2, 3)), rows, np.full(count, 9, np.int64))


def test_likeness_counts_how_far_matches_stand_out_and_never_against():
    target = described(np.eye(4))
    source = described(np.eye(4)[[1, 0, 2, 3]])  # the first two are each other's
    # a cosine is 1 in a quarter of the 16 pairs: mean 1/4, deviation sqrt(3)/4
    stands_out = 0.75 / (np.sqrt(3) / 4)
    for matches, expected in (
        ([[0, 1]], stands_out),
        ([[0, 1], [1, 0], [2, 2]], 3 * stands_out),
        ([[0, 0]], 0.0),
        ([[0, 0], [2, 2]], stands_out),
        (np.zeros((0, 2)), 0.0),
    ):
        rows = np.array(matches, np.int64)
        assert likeness(source, target, rows) == pytest.approx(expected, rel=1e-6)


def test_likeness_counts_matches_where_nothing_is_described():
    bare = described(np.zeros((3, 0)))
    assert likeness(bare, bare, np.array([[0, 1], [1, 2]])) == 2.0
    alike = described(np.ones((3, 4)) / 2)  # all say the same: nothing stands out
    assert likeness(alike, alike, np.array([[0, 1], [1, 2]])) == pytest.approx(0.0, abs=1e-4)


def leaning_view(xy, up):
    """Poles and level ground 1.7 m below a sensor that leans: ``up`` is in its frame."""
    T_lidar_level = make_transform(rotation_between(np.array([0, 0, 1.0]), up), np.zeros(3))
    ends = [np.column_stack([xy, np.full(len(xy), z)]) for z in (-1.5, 2.5)]
    empty = np.zeros((len(xy), 0), np.float32)
    lines = LineSet(np.stack(ends, axis=1), empty, np.full(len(xy), 9, np.int64))
    return lines.transformed(T_lidar_level), T_lidar_level


def leaning_up(x, y):
    return np.array([x, y, 1.0]) / np.linalg.norm([x, y, 1.0])


@pytest.fixture
def pair(rng):
    """Two views of 9 poles, each leaning its own way; the truth is planar in level frames."""
    truth = np.array([np.radians(130.0), 5.0, -8.0])
    target_xy = rng.uniform(-30, 30, (9, 2))
    c, s = np.cos(truth[0]), np.sin(truth[0])
    source_xy = (target_xy - truth[1:]) @ np.array([[c, -s], [s, c]])
    order = rng.permutation(9)
    views = []
    for xy, up in ((source_xy[order], leaning_up(0.1, 0.05)), (target_xy, leaning_up(-0.05, 0.12))):
        lines, _ = leaning_view(xy, up)
        views.append(PreparedView(view_of_lines(lines, up), SETTINGS))
    return (*views, truth, order)


def test_lines_that_a_pose_lays_on_each_other_are_named_by_their_rows(pair):
    source, target, truth, order = pair
    matches = matched_lines(source, target, lift(source, target, truth), 0.1)
    assert matches.tolist() == [[row, int(order[row])] for row in range(9)]
    assert len(matched_lines(source, target, invert(lift(source, target, truth)), 0.1)) < 9


def test_flatten_undoes_lift(pair):
    source, target, truth, _ = pair
    np.testing.assert_allclose(flatten(source, target, lift(source, target, truth)), truth)


def test_lift_lays_the_sources_ground_on_the_targets():
    xy = np.stack(np.meshgrid(np.arange(-20, 20, 1.0), np.arange(-20, 20, 1.0)), -1).reshape(-1, 2)
    up = np.array([0.0, 0.0, 1.0])

    def view(ground_z):
        cloud = np.c_[xy, np.full(len(xy), ground_z)].astype(np.float32)
        none = LineSet(np.zeros((0, 2, 3)), np.zeros((0, 0), np.float32), np.zeros(0, np.int64))
        return PreparedView(View(none, up, cloud, np.zeros(len(xy), np.float32)), SETTINGS)

    low, high = view(-1.7), view(-2.5)  # sensors 1.7 m and 2.5 m above the street
    T_low_high = lift(high, low, np.array([0.5, 3.0, -4.0]))
    np.testing.assert_allclose(T_low_high[:3, 3], [3.0, -4.0, 0.8], atol=1e-6)


def test_packing_keeps_a_view_to_the_centimetre(rng):
    points = np.concatenate([rng.uniform(-60, 60, (3000, 3)) * [1, 1, 0.02]])
    lines, _ = leaning_view(rng.uniform(-9, 9, (4, 2)), np.array([0, 0, 1.0]))
    view = make_view(points, lines, 0.5)
    again = unpack(pack(view))
    np.testing.assert_allclose(again.cloud, view.cloud, atol=0.0051)
    np.testing.assert_allclose(again.heights, view.heights, atol=0.01)
    assert again.lines is lines


@pytest.mark.parametrize("far_returns", [0, 12])
def test_lift_goes_by_the_ground_that_both_see_where_the_target_sees_little_there(far_returns, rng):
    """The target's street ends 10 m before the source; what it takes for ground there is 2 m up."""
    up = np.array([0.0, 0.0, 1.0])
    lines = LineSet(np.zeros((0, 2, 3)), np.zeros((0, 0), np.float32), np.zeros(0, np.int64))
    world = np.column_stack([rng.uniform((-30, -8), (60, 8), (9000, 2)), np.full(9000, -1.7)])
    seen = world[world[:, 0] < 30.0]
    wrong = np.column_stack(
        [rng.uniform((38, -5), (44, 5), (far_returns, 2)), np.full(far_returns, 0.3)]
    )
    target_cloud = np.concatenate([seen, wrong]).astype(np.float32)
    pose = np.array([2.5, 40.0, 1.0])
    T_target_source = from_yaw(pose[0], np.array([*pose[1:], 0.4]))
    from_source = (world - T_target_source[:3, 3]) @ T_target_source[:3, :3]
    near = np.hypot(from_source[:, 0], from_source[:, 1]) < 30.0
    source, target = (
        PreparedView(View(lines, up, cloud, np.zeros(len(cloud), np.float32)), SETTINGS)
        for cloud in (from_source[near].astype(np.float32), target_cloud)
    )
    T = lift(source, target, pose)
    np.testing.assert_allclose(T, T_target_source, atol=1e-5)  # clouds are single precision

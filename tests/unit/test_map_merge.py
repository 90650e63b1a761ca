from dataclasses import replace

import numpy as np
import pytest

from sl3d_slam.config import MapSettings
from sl3d_slam.geometry.se3 import from_yaw, invert, make_transform, rotation_between
from sl3d_slam.geometry.segments import directions, midpoints
from sl3d_slam.mapping.landmarks import mean_lines
from sl3d_slam.mapping.line_map import LineMap
from sl3d_slam.mapping.merge import agreeing_pairs, group_lines, standing
from sl3d_slam.types import LineKind, LineSet

UP = np.array([0.0, 0.0, 1.0])
DEFAULTS = MapSettings()


def pole(x, y, low=0.0, high=3.0):
    return np.array([[x, y, low], [x, y, high]])


def line_set(endpoints, descriptor=(1.0, 0.0), kind=LineKind.POLE):
    endpoints = np.asarray(endpoints, float).reshape(-1, 2, 3)
    count = len(endpoints)
    return LineSet(
        endpoints=endpoints,
        descriptors=np.tile(np.array(descriptor, np.float32), (count, 1)),
        num_points=np.full(count, 20, np.int64),
        kinds=np.full(count, kind, np.uint8),
        scores=np.full(count, 0.5, np.float32),
    )


def drive(count, step_m=3.0):
    """Poses of a drive on a bend, tilted, none the identity."""
    tilt = make_transform(
        rotation_between(np.array([0.06, -0.04, 1.0]) / np.sqrt(1.0052), UP), np.zeros(3)
    )
    return np.array(
        [
            from_yaw(0.4 + 0.05 * k, np.array([step_m * k, 0.2 * k, 0.03 * k])) @ tilt
            for k in range(count)
        ]
    )


def build(world_lines, poses, settings=DEFAULTS):
    """Build a map from the lines that each keyframe saw, given in the map frame."""
    seen = [lines.transformed(invert(T)) for lines, T in zip(world_lines, poses, strict=True)]
    up = np.array([T[:3, :3].T @ UP for T in poses])
    return LineMap.build(seen, poses, up, None, settings)


def noisy(endpoints, rng, sigma_m):
    """Observe lines with noise across them and ends that slide along them."""
    endpoints = np.asarray(endpoints, float)
    across = rng.normal(0, sigma_m, (len(endpoints), 1, 3))
    along = directions(endpoints)[:, None]
    across -= along * np.einsum("lij,lkj->lik", across, along)
    slide = rng.uniform(-0.2, 0.2, (len(endpoints), 2, 1)) * along
    return endpoints + across + slide


def test_repeated_observations_become_one_landmark_each(rng):
    truth = np.array(
        [pole(8.0 * k + 2.0, 6.0 * (-1) ** k, 0.1 * k, 3.0 + 0.1 * k) for k in range(6)]
    )
    poses, sigma_m = drive(25, 1.0), 0.04
    seen = [line_set(noisy(truth[rng.permutation(6)], rng, sigma_m)) for _ in poses]
    built = build(seen, poses)
    assert len(built) == 6
    assert (built.support == 25).all()
    place = midpoints(built.lines.endpoints)[:, :2]
    apart = np.linalg.norm(place[:, None] - midpoints(truth)[None, :, :2], axis=2)
    assert sorted(apart.argmin(axis=1)) == list(range(6))
    # two axes of sigma / sqrt(25) each; four times that is exceeded once in 3,000
    assert apart.min(axis=1).max() < 4 * sigma_m * np.sqrt(2 / 25)
    ends = np.sort(built.lines.endpoints[:, :, 2], axis=1) - truth[apart.argmin(axis=1), :, 2]
    assert np.abs(ends).max() <= 0.2 + 1e-9  # as far as the ends of observations slide


def test_position_is_mean_of_good_observations_not_of_one_bad_one():
    poses = drive(9)
    truth = [line_set([pole(20.0, 3.0)])] * 8 + [line_set([pole(20.0, 3.35)])]
    built = build(truth, poses)
    assert len(built) == 1
    # the plain mean is off by 0.35 / 9 = 0.039; Cauchy weights at 3.5 scales leave under a tenth
    assert abs(midpoints(built.lines.endpoints)[0, 1] - 3.0) < 0.005


def test_what_moves_is_dropped_and_its_trail_is_no_line():
    poses = drive(20)
    walker = [pole(5.0 + 0.9 * k, 4.0, 0.3, 1.8) for k in range(20)]
    seen = [line_set([walker[k], pole(30.0, -5.0)]) for k in range(20)]
    built = build(seen, poses)
    assert len(built) == 1
    assert built.support.tolist() == [20]
    assert built.indices.tolist() == [0] * 20


def test_line_seen_once_stays_only_where_there_was_no_second_chance():
    poses = drive(30)  # 87 m
    ahead = poses[29][:3, 3] + np.array([21.0, 0.0, 0.0])
    passed = poses[15][:3, 3] + np.array([0.0, 4.0, 0.0])
    seen = [line_set(np.zeros((0, 2, 3)))] * 30
    seen[29] = line_set([pole(*ahead[:2])])
    seen[15] = line_set([pole(*passed[:2])])
    built = build(seen, poses)
    assert len(built) == 1
    assert np.allclose(midpoints(built.lines.endpoints)[0, :2], ahead[:2])


def test_two_poles_a_metre_apart_stay_two(rng):
    truth = np.array([pole(10.0, 5.0), pole(11.0, 5.0)])
    built = build([line_set(noisy(truth, rng, 0.1)) for _ in range(30)], drive(30, 0.5))
    assert len(built) == 2


def test_pieces_of_a_pole_join_and_a_lamp_high_above_does_not():
    poses = drive(6)
    seen = [line_set([pole(9.0, 4.0, 0.0, 1.5), pole(9.0, 4.0, 2.0, 4.0)])] * 6
    joined = build(seen, poses)
    assert len(joined) == 1
    assert joined.support.tolist() == [6]  # two pieces in a keyframe count once
    assert np.allclose(sorted(joined.lines.endpoints[0, :, 2]), [0.0, 4.0], atol=1e-6)
    apart = build([line_set([pole(9.0, 4.0, 0.0, 1.5), pole(9.0, 4.0, 3.5, 5.0)])] * 6, poses)
    assert len(apart) == 2


def test_pieces_of_a_long_eave_join_and_its_parallel_does_not():
    poses = drive(12)
    seen = []
    for k in range(12):
        start, end = 2.0 * k, 2.0 * k + 8.0
        pieces = [[[start, y, 5.0], [end, y, 5.0]] for y in (8.0, 9.0)]
        seen.append(line_set(pieces, kind=LineKind.OTHER_EDGE))
    built = build(seen, poses, MapSettings(min_seen_share=0.0))
    assert len(built) >= 2
    assert set(np.round(midpoints(built.lines.endpoints)[:, 1], 6)) == {8.0, 9.0}
    assert (built.lines.kinds == LineKind.OTHER_EDGE).all()


def test_descriptor_is_the_unit_mean_and_kind_the_commonest():
    poses = drive(3)
    seen = [
        line_set([pole(6.0, 3.0)], (1.0, 0.0), LineKind.VERTICAL_EDGE),
        line_set([pole(6.0, 3.0)], (0.0, 1.0), LineKind.POLE),
        line_set([pole(6.0, 3.0)], (0.0, 1.0), LineKind.VERTICAL_EDGE),
    ]
    built = build(seen, poses)
    assert np.allclose(built.lines.descriptors, np.array([[1.0, 2.0]]) / np.sqrt(5), atol=1e-6)
    assert built.lines.kinds.tolist() == [LineKind.VERTICAL_EDGE]
    assert built.lines.num_points.tolist() == [20]


def test_long_observations_say_which_way_and_ends_carry_no_order():
    long = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 6.0]])
    short = np.array([[0.0, 0.0, 3.0], [0.1, 0.0, 2.0]])  # leans by 5.7 degrees, and upside down
    mean = mean_lines(line_set([long, short]), np.ones(2), np.zeros(2, np.int64))
    lean = np.degrees(np.arccos(abs(directions(mean.endpoints)[0, 2])))
    assert lean == pytest.approx(5.7 / 37, abs=0.01)  # one part in 36 + 1
    assert np.allclose(np.sort(mean.endpoints[0, :, 2]), [0.0, 6.0], atol=0.01)


def test_a_row_that_stands_for_many_counts_as_many():
    rows = line_set([pole(5.0, 2.0), pole(5.0, 2.02)])
    rows = replace(rows, descriptors=np.array([[1.0, 0.0], [0.0, 1.0]], np.float32))
    once = mean_lines(rows, np.array([3.0, 1.0]), np.zeros(2, np.int64))
    many = mean_lines(rows.take(np.array([0, 0, 0, 1])), np.ones(4), np.zeros(4, np.int64))
    assert np.allclose(once.endpoints, many.endpoints)
    assert np.allclose(once.descriptors, many.descriptors)
    assert np.allclose(once.descriptors, np.array([[3.0, 1.0]]) / np.sqrt(10))


def test_order_of_lines_in_a_scan_and_of_their_ends_changes_nothing(rng):
    truth = np.array([pole(7.0 * k, 5.0 * (-1) ** k) for k in range(5)])
    poses = drive(10)
    seen = [line_set(noisy(truth, rng, 0.05)) for _ in poses]
    flipped = []
    for lines in seen:
        endpoints = lines.endpoints[rng.permutation(5)]
        turn = rng.random(5) < 0.5
        endpoints[turn] = endpoints[turn, ::-1]
        flipped.append(line_set(endpoints))
    first, second = build(seen, poses), build(flipped, poses)
    ends = []
    for built in (first, second):
        by_x = built.lines.endpoints[np.argsort(built.lines.endpoints[:, 0, 0])]
        ends.append(np.take_along_axis(by_x, np.argsort(by_x[:, :, 2:], axis=1), axis=1))
    assert np.allclose(*ends, atol=1e-9)
    again = build(seen, poses)
    assert np.array_equal(first.lines.endpoints, again.lines.endpoints)


def test_the_densest_line_gathers_its_neighbours():
    beside = np.array([pole(9.0, y) for y in (0.0, 0.35, 0.35, 0.35, 0.7, 5.0)])
    groups = group_lines(beside, np.ones(6), np.ones(6, bool), DEFAULTS)
    assert groups.tolist() == [0, 0, 0, 0, 0, 1]
    weights = np.array([9.0, 1.0, 1.0, 1.0, 1.0, 1.0])  # a row that stands for nine
    groups = group_lines(beside, weights, np.ones(6, bool), DEFAULTS)
    assert groups.tolist() == [0, 0, 0, 0, 1, 2]


def test_two_pieces_pointing_opposite_ways_are_one_line():
    tilted = np.array([[[0.0, 0.0, 0.0], [0.2, 0.0, 2.0]], [[0.4, 0.0, 4.0], [0.22, 0.0, 2.2]]])
    assert group_lines(tilted, np.ones(2), np.ones(2, bool), DEFAULTS).tolist() == [0, 0]
    half = MapSettings(merge_distance_m=0.05)
    assert group_lines(tilted, np.ones(2), np.ones(2, bool), half).tolist() == [0, 0]


def test_pairs_agree_with_brute_force(rng):
    endpoints = np.array(
        [pole(*rng.uniform(0, 4, 2), *np.sort(rng.uniform(0, 5, 2))) for _ in range(80)]
    )
    endpoints += rng.normal(0, 0.03, endpoints.shape)
    upright = standing(endpoints, np.tile(UP, (80, 1)))
    settings = MapSettings()
    pairs = agreeing_pairs(endpoints, upright, settings)
    along = directions(endpoints)
    for i in range(80):
        mine = set(pairs.second[pairs.first == i].tolist())
        for j in range(80):
            if i == j or upright[i] != upright[j]:
                assert j not in mine
                continue
            angle = np.degrees(np.arccos(min(1.0, abs(along[i] @ along[j]))))
            z = [np.sort(endpoints[k, :, 2]) for k in (i, j)]
            low, high = max(z[0][0], z[1][0]), min(z[0][1], z[1][1])
            at = [
                endpoints[k, 0, :2]
                + along[k, :2] / along[k, 2] * ((low + high) / 2 - endpoints[k, 0, 2])
                for k in (i, j)
            ]
            distance = np.linalg.norm(at[0] - at[1])
            margins = (angle - 8.0, low - high - 1.0, distance - 0.4)
            if min(abs(margin) for margin in margins) > 0.05:  # unclear near the limits
                assert (j in mine) == (max(margins) < 0)


@pytest.mark.parametrize("count", [0, 1])
def test_few_lines_are_no_special_case(count):
    endpoints = np.array([pole(1.0, 2.0)] * count).reshape(-1, 2, 3)
    groups = group_lines(endpoints, np.ones(count), np.ones(count, bool), MapSettings())
    assert groups.tolist() == list(range(count))

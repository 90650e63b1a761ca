from itertools import combinations, pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chi2

from sl3d_slam.config import GraphSettings
from sl3d_slam.geometry.se3 import adjoint, exp, from_yaw, invert, log
from sl3d_slam.graph.agreement import Agreement
from sl3d_slam.graph.batched import adjoints, inverts, logs
from sl3d_slam.graph.chain import OdometryChain
from sl3d_slam.graph.clique import maximum_clique
from sl3d_slam.graph.consistency import check_odometry, check_pairs, stack_loops
from sl3d_slam.graph.noise import step_covariance
from sl3d_slam.types import LoopConstraint

SETTINGS = GraphSettings(  # the noise that the worlds of these tests are made with
    odometry_rotation_sigma_deg=0.05,
    odometry_translation_sigma_m=0.02,
    odometry_translation_fraction=0.005,
    drift_inflation=1.0,  # their noise is white
)
LOOP_SIGMAS = np.array([0.004, 0.006, 0.002, 0.05, 0.03, 0.08])
INFORMATION = np.diag(LOOP_SIGMAS**-2.0)


def winding_drive(count):
    """Poses of a climbing, turning drive with steps of 2 m; no two steps commute."""
    poses = [exp(np.array([0.1, -0.2, 0.4, 20.0, -10.0, 3.0]))]
    for k in range(count - 1):
        poses.append(poses[-1] @ exp(np.array([0.02, -0.01 * (k % 3), 0.15, 2.0, 0.1, 0.05])))
    return np.array(poses)


def chain_of(poses, settings=SETTINGS):
    chain = OdometryChain(settings)
    for k, pose in enumerate(poses):
        chain.append(k, pose, 1)
    return chain


def sampled_odometry(truth, rng):
    poses = [truth[0]]
    for before, after in pairwise(truth):
        step = invert(before) @ after
        sigmas = np.sqrt(np.diag(step_covariance(step, SETTINGS)))
        poses.append(poses[-1] @ step @ exp(sigmas * rng.standard_normal(6)))
    return np.array(poses)


def sampled_loop(truth, target, query, rng):
    noise = exp(LOOP_SIGMAS * rng.standard_normal(6))
    T_target_query = invert(truth[target]) @ truth[query] @ noise
    return LoopConstraint(target, query, T_target_query, INFORMATION, 9)


def test_batched_transforms_are_those_of_se3(rng):
    twists = rng.standard_normal((20, 6))
    twists[0] = 0.0
    twists[1, :3] = 1e-9
    T = np.array([exp(xi) for xi in twists])
    np.testing.assert_allclose(logs(T), [log(one) for one in T], atol=1e-9)
    np.testing.assert_allclose(adjoints(T), [adjoint(one) for one in T], atol=1e-12)
    np.testing.assert_allclose(inverts(T), [invert(one) for one in T], atol=1e-12)


# Squared Mahalanobis distances of honest measurements have mean 6 and variance 12; 80 samples fix
# the mean to 0.4. The pairs: legs apart, legs that share most of their steps (forwards and
# backwards), and one loop inside the other.
@pytest.mark.parametrize("pair", [((0, 5), (2, 7)), ((0, 2), (6, 8)), ((6, 8), (0, 2))])
def test_honest_pairs_of_loops_have_the_distances_they_should(rng, pair):
    truth = winding_drive(9)
    squared = []
    for _ in range(80):
        chain = chain_of(sampled_odometry(truth, rng))
        first, second = (stack_loops(chain, [sampled_loop(truth, *ends, rng)]) for ends in pair)
        squared.append(check_pairs(chain, first, second)[0][0])
    assert np.mean(squared) == pytest.approx(6.0, abs=1.5)


@pytest.mark.parametrize("axis", range(6))
@pytest.mark.parametrize("disturbed", [0, 1])
def test_a_loop_s_noise_is_carried_to_where_the_cycle_closes(axis, disturbed):
    # a loop that is uncertain in one direction alone, wrong there by one sigma: one sigma in all.
    # Carried to another place or by another rotation it would lie where nothing is uncertain.
    exact = GraphSettings(
        odometry_rotation_sigma_deg=1e-5,
        odometry_translation_sigma_m=1e-6,
        odometry_rotation_fraction=0.0,
        odometry_translation_fraction=0.0,
    )
    truth = winding_drive(12)
    chain = chain_of(truth, exact)
    sigmas = np.full((2, 6), 1e-6)
    sigmas[disturbed, axis] = 1e-3
    columns = []
    for k, (target, query) in enumerate(((0, 5), (2, 11))):
        wrong = exp(1e-3 * np.eye(6)[axis] * (k == disturbed))
        T_target_query = invert(truth[target]) @ truth[query] @ wrong
        loop = LoopConstraint(target, query, T_target_query, np.diag(sigmas[k] ** -2.0), 9)
        columns.append(stack_loops(chain, [loop]))
    squared, _ = check_pairs(chain, *columns)
    assert squared[0] == pytest.approx(1.0, abs=0.05)


def test_shared_steps_are_counted_once(rng):
    # loops that are nearly exact: only the odometry's noise is left in the cycle, and what both
    # legs share almost cancels where they pass it in opposite directions
    truth = winding_drive(40)
    chain = chain_of(truth)
    loops = [
        LoopConstraint(a, b, invert(truth[a]) @ truth[b], 1e10 * np.eye(6), 9)
        for a, b in ((0, 2), (36, 38))
    ]
    arrays = stack_loops(chain, loops)
    _, spread = check_pairs(chain, arrays.take(np.array([0])), arrays.take(np.array([1])))
    apart = chain.noise_between(np.array([0]), np.array([36]))[0, 3:, 3:]
    assert spread[0] < 0.2 * np.trace(apart)


def test_honest_loops_agree_with_the_odometry_as_often_as_they_should(rng):
    truth = winding_drive(9)
    squared = []
    for _ in range(80):
        chain = chain_of(sampled_odometry(truth, rng))
        loop = stack_loops(chain, [sampled_loop(truth, 1, 8, rng)])
        squared.append(check_odometry(chain, loop, 3.0).squared)
    assert np.mean(squared) == pytest.approx(6.0, abs=1.5)


def test_the_odometry_check_says_how_far_off_a_loop_is():
    truth = winding_drive(14)
    chain = chain_of(truth)
    wrong = invert(truth[1]) @ truth[13] @ invert(exp(np.array([0, 0, 0.3, 0, 0, 0.0])))
    check = check_odometry(
        chain, stack_loops(chain, [LoopConstraint(1, 13, wrong, INFORMATION, 9)]), 3.0
    )
    assert check.offset_deg == pytest.approx(np.degrees(0.3))
    assert check.offset_m == pytest.approx(0.0, abs=1e-9)
    assert check.squared > check.squared_inflated > chi2.ppf(0.999, 6)


def test_covariance_between_keyframes_does_not_depend_on_where_the_drive_started():
    truth = winding_drive(12)
    near, far = chain_of(truth), chain_of(exp(np.array([1, 2, -1, 3000, 2000, 50.0])) @ truth)
    one, other = np.array([3]), np.array([11])
    np.testing.assert_allclose(
        near.covariances(one, other), far.covariances(one, other), rtol=1e-4, atol=1e-9
    )


def test_the_drift_between_two_keyframes_is_how_far_sampled_odometry_strays(rng):
    truth = winding_drive(30)
    T_true = invert(truth[4]) @ truth[27]
    gaps_m = []
    for _ in range(400):
        odometry = sampled_odometry(truth, rng)
        T_first_last = invert(odometry[4]) @ odometry[27]
        gaps_m.append(np.linalg.norm(T_first_last[:3, 3] - T_true[:3, 3]))
    drift_m = chain_of(truth).drift_m(4, 27)
    assert abs(np.sqrt(np.mean(np.square(gaps_m))) / drift_m - 1.0) < 0.1


def test_a_turn_that_errs_early_moves_what_comes_after_and_not_what_was_before():
    chain = OdometryChain(GraphSettings(odometry_rotation_sigma_deg=1.0, drift_inflation=1.0))
    for k, (x_m, num_scans) in enumerate([(0.0, 1), (1.0, 25), (101.0, 1)]):
        chain.append(k, from_yaw(0.7, np.array([x_m, 0.0, 0.0])), num_scans)
    lever_m = np.radians(1.0) * 5.0 * 100.0  # of 25 steps, on both axes across the way
    assert abs(chain.drift_m(0, 2) / (np.sqrt(2.0) * lever_m) - 1.0) < 0.05
    assert chain.drift_m(2, 0) < 0.3 * lever_m


def test_the_chain_grows_beyond_its_first_room():
    truth = winding_drive(200)
    chain = chain_of(truth)
    assert len(chain) == 200
    np.testing.assert_allclose(chain.poses(np.arange(200)), truth, atol=1e-12)
    assert np.all(
        np.diff(np.trace(chain.covariances(np.zeros(200, int), np.arange(200)), axis1=1, axis2=2))
        > 0
    )


def test_true_loops_agree_and_a_false_one_agrees_with_none(rng):
    truth = np.array(
        [
            from_yaw(0.05 * k, np.array([np.cos(0.05 * k), np.sin(0.05 * k), 0]) * 30)
            for k in range(160)
        ]
    )
    chain = chain_of(sampled_odometry(truth, rng))
    loops = [sampled_loop(truth, k, k + 125, rng) for k in range(0, 30, 3)]
    false = LoopConstraint(
        7, 133, loops[0].T_target_query @ from_yaw(0.0, np.array([2.5, 0, 0])), INFORMATION, 9
    )
    table = Agreement(chain, float(chi2.ppf(0.9999, 6)))
    for loop in [*loops, false] * 8:  # 88 rows: more than the table's first room
        table.append(stack_loops(chain, [loop]))
    is_true = np.tile([True] * 10 + [False], 8)
    np.testing.assert_array_equal(table.consistent, table.consistent.T)
    assert table.consistent[np.ix_(is_true, is_true)].all()
    assert not table.consistent[np.ix_(is_true, ~is_true)].any()
    assert table.confirms[np.ix_(is_true, is_true)].mean() > 0.9


def test_loops_far_apart_agree_without_confirming(rng):
    truth = winding_drive(400)
    chain = chain_of(truth)
    table = Agreement(chain, float(chi2.ppf(0.9999, 6)))
    for ends in ((0, 10), (380, 390)):
        table.append(stack_loops(chain, [sampled_loop(truth, *ends, rng)]))
    assert table.consistent.all()
    assert not table.confirms.any()


def largest_by_trying_all(adjacency):
    count = len(adjacency)
    for size in range(count, 0, -1):
        for chosen in combinations(range(count), size):
            if all(adjacency[a, b] for a, b in combinations(chosen, 2)):
                return size
    return 0


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 9), st.floats(0.1, 0.95), st.integers(0, 10**6))
def test_the_clique_is_as_large_as_any(count, density, seed):
    rng = np.random.default_rng(seed)
    upper = np.triu(rng.random((count, count)) < density, 1)
    adjacency = upper | upper.T
    clique = maximum_clique(adjacency)
    assert all(adjacency[a, b] for a, b in combinations(clique, 2))
    assert len(clique) == largest_by_trying_all(adjacency)
    assert clique == sorted(clique) == maximum_clique(adjacency)


def test_an_equally_large_clique_does_not_displace_the_incumbent():
    blocks = np.kron(np.eye(3), np.ones((4, 4))).astype(bool)
    for incumbent in ([0, 1, 2, 3], [4, 5, 6, 7], [8, 9, 10, 11]):
        assert maximum_clique(blocks, incumbent) == incumbent
    assert len(maximum_clique(blocks, [4, 5, 6])) == 4


def test_the_search_goes_on_where_the_greedy_choice_fails():
    adjacency = np.zeros((9, 9), dtype=bool)
    adjacency[0, 1:6] = adjacency[1:6, 0] = True  # the best connected vertex is in pairs only
    adjacency[6:, 6:] = True
    assert maximum_clique(adjacency) == [6, 7, 8]


def test_a_planted_clique_is_found_among_hundreds(rng):
    upper = np.triu(rng.random((400, 400)) < 0.5, 1)
    adjacency = upper | upper.T
    planted = np.sort(rng.choice(400, 60, replace=False))
    adjacency[np.ix_(planted, planted)] = True
    assert maximum_clique(adjacency) == planted.tolist()


def test_drift_is_wider_than_its_steps_over_a_stretch_but_a_step_is_what_it_is():
    truth = winding_drive(9)
    wide = SETTINGS.model_copy(update={"drift_inflation": 3.0})
    ends = np.array([1]), np.array([8])
    chains = [OdometryChain(settings) for settings in (SETTINGS, wide)]
    steps = [[chain.append(k, pose, 1) for k, pose in enumerate(truth)] for chain in chains]
    np.testing.assert_array_equal(steps[0][5], steps[1][5])
    narrow, wider = (chain.covariances(*ends)[0] for chain in chains)
    np.testing.assert_allclose(wider, 9.0 * narrow, rtol=1e-9, atol=1e-12)

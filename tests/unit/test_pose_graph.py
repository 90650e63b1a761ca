from itertools import pairwise

import gtsam
import numpy as np
import pytest

from sl3d_slam.config import GraphSettings
from sl3d_slam.errors import GraphError
from sl3d_slam.geometry.se3 import distance_m, exp, from_yaw, invert, log, rotation_angle_rad
from sl3d_slam.graph.final import marginal_covariances, optimise_all_scans
from sl3d_slam.graph.noise import (
    chain_covariance,
    information_to_gtsam,
    step_covariance,
    weakness,
)
from sl3d_slam.graph.pose_graph import PoseGraph
from sl3d_slam.graph.solve import Edge, anchor, between_factor, optimise
from sl3d_slam.types import LoopConstraint

SETTINGS = GraphSettings()
TIGHT = np.diag(np.repeat([1e-3**-2, 0.01**-2], 3))  # 1 mrad, 1 cm: far better than the odometry
STEP = exp(np.array([0.02, -0.03, 0.3, 1.0, 0.4, -0.1]))  # not its own inverse in any coordinate


def square_drive(side=20):
    """Poses once around a square and 5 m into the second lap, 1 m apart, facing forwards."""
    poses = [from_yaw(0.3, np.array([3.0, -2.0, 1.0]))]
    for k in range(4 * side + 5):
        turn = np.pi / 2 if k % side == side - 1 else 0.0
        poses.append(poses[-1] @ from_yaw(turn, np.array([1.0, 0.0, 0.01])))
    return np.array(poses)


def drifted(truth, xi):
    """Odometry with the same error ``xi`` in every step."""
    poses = [truth[0]]
    for before, after in pairwise(truth):
        poses.append(poses[-1] @ invert(before) @ after @ exp(xi))
    return np.array(poses)


DRIFT = np.array([0.0002, -0.0001, 0.0005, 0.005, -0.003, 0.002])


def loop_between(truth, target, query, information=TIGHT):
    return LoopConstraint(
        target, query, invert(truth[target]) @ truth[query], information, num_inliers=9
    )


def built(odometry):
    graph = PoseGraph(SETTINGS)
    for k, pose in enumerate(odometry):
        graph.add_keyframe(k, pose, 1)
    return graph


def test_a_loop_with_a_shift_and_a_turn_closes_a_drifting_square():
    truth = square_drive()
    odometry = drifted(truth, DRIFT)
    graph = built(odometry)
    before_m = distance_m(invert(truth[-1]) @ graph.estimate(len(truth) - 1))
    (verdict,) = graph.add_loop(loop_between(truth, 2, len(truth) - 1))
    error = invert(truth[-1]) @ graph.estimate(len(truth) - 1)
    # the target is 2 steps of drift from the start; the loop itself is good to 1 cm and 1 mrad
    assert verdict.status == "accepted"
    assert before_m > 0.5
    assert distance_m(error) < 0.05
    assert rotation_angle_rad(error) < 0.003


def test_a_loop_the_wrong_way_round_is_refused():
    truth = square_drive()
    graph = built(drifted(truth, DRIFT))
    loop = loop_between(truth, 2, len(truth) - 6)
    swapped = LoopConstraint(2, len(truth) - 6, invert(loop.T_target_query), TIGHT, 9)
    assert distance_m(loop.T_target_query @ loop.T_target_query) > 1.0  # not its own inverse
    (verdict,) = graph.add_loop(swapped)
    assert verdict.status == "rejected"
    assert "contradicts the odometry" in verdict.reason


def test_between_factor_is_zero_at_the_measured_pose_only_one_way_round():
    T_world_target = exp(np.array([0.1, 0.2, -0.4, 5.0, -3.0, 1.0]))
    values = gtsam.Values()
    values.insert(4, gtsam.Pose3(T_world_target))
    values.insert(9, gtsam.Pose3(T_world_target @ STEP))
    assert between_factor(Edge(4, 9, STEP, TIGHT)).error(values) < 1e-18
    assert between_factor(Edge(9, 4, STEP, TIGHT)).error(values) > 1.0
    assert between_factor(Edge(4, 9, invert(STEP), TIGHT)).error(values) > 1.0


def test_information_is_rotation_first_at_the_query_frame():
    information = np.diag([1.0, 4.0, 9.0, 16.0, 25.0, 36.0])
    T_world_target = exp(np.array([0.1, 0.2, -0.4, 5.0, -3.0, 1.0]))
    factor = between_factor(Edge(4, 9, STEP, information))
    for axis in range(6):
        xi = 1e-3 * np.eye(6)[axis]
        values = gtsam.Values()
        values.insert(4, gtsam.Pose3(T_world_target))
        values.insert(9, gtsam.Pose3(T_world_target @ STEP @ exp(xi)))
        # 2 * error = xi^T information xi, so the axis shows by its own number
        assert 2e6 * factor.error(values) == pytest.approx((axis + 1) ** 2, rel=1e-6)


def test_between_jacobians_match_finite_differences():
    poses = {4: exp(np.array([0.1, 0.2, -0.4, 5.0, -3.0, 1.0]))}
    poses[9] = poses[4] @ STEP @ exp(np.array([0.02, 0.01, -0.03, 0.1, 0.2, -0.1]))
    factor = between_factor(Edge(4, 9, STEP, np.eye(6)))

    def error(changed, xi):
        values = gtsam.Values()
        for key, pose in poses.items():
            values.insert(key, gtsam.Pose3(pose @ exp(xi) if key == changed else pose))
        return factor.unwhitenedError(values)

    values = gtsam.Values()
    for key, pose in poses.items():
        values.insert(key, gtsam.Pose3(pose))
    jacobian, _ = factor.linearize(values).jacobian()
    for column, key in ((0, 4), (6, 9)):
        for axis in range(6):
            xi = 1e-6 * np.eye(6)[axis]
            numeric = (error(key, xi) - error(key, -xi)) / 2e-6
            np.testing.assert_allclose(jacobian[:, column + axis], numeric, atol=1e-7)


def test_step_sigmas_are_rotation_first():
    sigmas = np.sqrt(np.diag(step_covariance(np.eye(4), SETTINGS)))
    assert sigmas[:3] == pytest.approx(np.radians(SETTINGS.odometry_rotation_sigma_deg))
    assert sigmas[3:] == pytest.approx(SETTINGS.odometry_translation_sigma_m)


def test_chain_covariance_is_that_of_sampled_chains(rng):
    T_first_last, num_scans = exp(np.array([0.1, 0.0, 0.8, 12.0, 3.0, 0.5])), 8
    step = exp(log(T_first_last) / num_scans)
    sigmas = np.sqrt(np.diag(step_covariance(step, SETTINGS)))
    errors = []
    for _ in range(1000):
        T = np.eye(4)
        for xi in sigmas * rng.standard_normal((num_scans, 6)):
            T = T @ step @ exp(xi)
        errors.append(log(invert(T_first_last) @ T))
    predicted = chain_covariance(T_first_last, num_scans, SETTINGS)
    scale = np.sqrt(np.outer(np.diag(predicted), np.diag(predicted)))
    # 1,000 samples fix a correlation to 1 / sqrt(1000) = 0.032; five times that
    np.testing.assert_allclose(np.cov(np.array(errors).T) / scale, predicted / scale, atol=0.16)


def test_a_longer_chain_is_less_certain():
    # noise that comes with each scan; the share of the motion does not depend on their number
    settings = GraphSettings(odometry_rotation_fraction=0.0, odometry_translation_fraction=0.0)
    one = chain_covariance(STEP, 1, settings)
    many = chain_covariance(STEP, 10, settings)
    assert np.all(np.linalg.eigvalsh(many - one) > -1e-12)
    with pytest.raises(GraphError, match="at least 1 scan"):
        chain_covariance(STEP, 0, SETTINGS)


def poles_only():
    """Information of vertical poles alone: yaw, x and y are fixed; roll, pitch and z are free."""
    return np.diag([0.0, 0.0, 1e4, 1e4, 1e4, 0.0])


@pytest.mark.parametrize(
    ("information", "complaint"),
    [
        (poles_only(), "leaves 3 of 6 directions free"),
        (np.zeros((6, 6)), "leaves 6 of 6 directions free"),
        (np.diag([1e4, 1e4, 1e4, 1e4, 1e4, 1e-9]), "leaves 1 of 6 directions free"),
        (np.diag([1e4, 1e4, 1e4, 1e4, 1e4, -1.0]), "leaves 1 of 6 directions free"),
        (np.diag([np.nan, 1.0, 1.0, 1.0, 1.0, 1.0]), "not finite"),
        (np.eye(6) + np.eye(6, k=1), "not symmetric"),
    ],
)
def test_weak_information_never_enters_a_graph(information, complaint):
    assert complaint in weakness(information)
    with pytest.raises(GraphError, match=complaint):
        information_to_gtsam(information)
    truth = square_drive()
    graph = built(truth)
    before = graph.estimate(30)
    (verdict,) = graph.add_loop(loop_between(truth, 2, 84, information))
    assert verdict.status == "rejected"
    assert complaint in verdict.reason
    np.testing.assert_array_equal(graph.estimate(30), before)


def test_correlated_information_is_kept_whole(rng):
    A = rng.standard_normal((6, 6))
    information = A @ A.T + np.eye(6)
    model = information_to_gtsam(information)
    np.testing.assert_allclose(model.information(), information, rtol=1e-9)


def test_a_single_keyframe_stays_where_odometry_put_it():
    pose = exp(np.array([0.1, -0.2, 0.7, 4.0, 5.0, 6.0]))
    graph = PoseGraph(SETTINGS)
    graph.add_keyframe(7, pose, 3)
    np.testing.assert_allclose(graph.estimate(7), pose, atol=1e-9)
    assert list(graph.estimates()) == [7]
    assert graph.settle() == []
    final = optimise_all_scans(pose[None], {7: 0}, graph.estimates(), [], SETTINGS)
    np.testing.assert_allclose(final.T_world_lidar[0], pose, atol=1e-9)


def test_no_scans_give_no_poses():
    assert len(optimise_all_scans(np.zeros((0, 4, 4)), {}, {}, [], SETTINGS).T_world_lidar) == 0


def test_unknown_and_repeated_keyframes_are_named():
    graph = built(square_drive()[:3])
    with pytest.raises(GraphError, match="keyframe 1 is already in the graph"):
        graph.add_keyframe(1, np.eye(4), 1)
    with pytest.raises(GraphError, match="keyframe 55 is not in the graph"):
        graph.add_loop(LoopConstraint(0, 55, STEP, TIGHT, 9))
    with pytest.raises(GraphError, match="keyframe 55"):
        graph.estimate(55)
    with pytest.raises(GraphError, match=r"keyframe 9's odometry.*not finite"):
        graph.add_keyframe(9, np.full((4, 4), np.nan), 1)
    with pytest.raises(GraphError, match="not a rotation and a translation"):
        graph.add_keyframe(9, 2.0 * np.eye(4), 1)
    assert graph.verdicts == []


def test_a_keyframe_cannot_close_a_loop_with_itself():
    graph = built(square_drive()[:3])
    (verdict,) = graph.add_loop(LoopConstraint(2, 2, STEP, TIGHT, 9))
    assert (verdict.status, verdict.reason) == ("rejected", "joins a keyframe with itself")


def test_rounded_rotations_do_not_make_the_system_indeterminate():
    truth = square_drive()
    rounded = truth.copy()
    rounded[:, :3, :3] = np.round(rounded[:, :3, :3] * (1.0 + 1e-6), 6)
    graph = built(rounded)
    graph.add_loop(loop_between(truth, 2, 84))
    for pose in graph.estimates().values():
        np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)


def test_the_final_optimisation_reaches_every_scan():
    truth = square_drive()
    odometry = drifted(truth, DRIFT)
    keyframes = {k: scan for k, scan in enumerate(range(0, len(truth), 4))}
    graph = PoseGraph(SETTINGS)
    for k, scan in keyframes.items():
        graph.add_keyframe(k, odometry[scan], 4)
    loops = [
        LoopConstraint(a, b, invert(truth[keyframes[a]]) @ truth[keyframes[b]], TIGHT, 9)
        for a, b in ((0, 20), (0, 21), (1, 21))
    ]
    for loop in loops:
        graph.add_loop(loop)
    accepted = graph.accepted_loops
    assert len(accepted) == 3
    final = optimise_all_scans(odometry, keyframes, graph.estimates(), accepted, SETTINGS)
    before_m = np.linalg.norm(odometry[:, :3, 3] - truth[:, :3, 3], axis=1)
    after_m = np.linalg.norm(final.T_world_lidar[:, :3, 3] - truth[:, :3, 3], axis=1)
    # white-noise graph against a constant bias: the middle improves, the last quarter most
    assert after_m.max() < 0.5 * before_m.max()
    assert np.all(after_m[64:] < 0.35 * before_m[64:])
    steps = [distance_m(invert(a) @ b) for a, b in pairwise(final.T_world_lidar)]
    assert max(steps) < 1.1  # no seam at a keyframe: every step is still about 1 m
    live = np.array([pose[:3, 3] for pose in graph.estimates().values()])
    spread = final.T_world_lidar[list(keyframes.values())][:, :3, 3]
    # the live graph takes the four steps between keyframes as equal, which they are not in a turn
    np.testing.assert_allclose(spread, live, atol=0.08)


def test_the_final_optimisation_needs_no_start():
    truth = square_drive()
    odometry = drifted(truth, DRIFT)
    same = {k: k for k in range(len(truth))}
    loops = [loop_between(truth, 2, 84)]
    with_start = optimise_all_scans(
        odometry, same, {0: odometry[0], 40: truth[40]}, loops, SETTINGS
    )
    without = optimise_all_scans(odometry, same, {}, loops, SETTINGS)
    np.testing.assert_allclose(with_start.T_world_lidar, without.T_world_lidar, atol=1e-6)


def test_the_final_optimisation_refuses_what_it_cannot_solve():
    truth = square_drive()
    same = {k: k for k in range(len(truth))}
    with pytest.raises(GraphError, match="no scan belongs to keyframe 900"):
        optimise_all_scans(truth, same, {}, [LoopConstraint(0, 900, STEP, TIGHT, 9)], SETTINGS)
    weak = [loop_between(truth, 2, 84, poles_only())]
    with pytest.raises(GraphError, match="3 of 6 directions free"):
        optimise_all_scans(truth, same, {}, weak, SETTINGS)
    broken = truth.copy()
    broken[5] = np.nan
    with pytest.raises(GraphError, match="transform 5 holds values that are not finite"):
        optimise_all_scans(broken, same, {}, [], SETTINGS)


def test_a_disconnected_session_is_named():
    poses = {1: np.eye(4), 2: STEP, 7: np.eye(4), gtsam.symbol("b", 3): STEP}
    edges = [Edge(1, 2, STEP, TIGHT), Edge(7, gtsam.symbol("b", 3), STEP, TIGHT)]
    with pytest.raises(GraphError, match="in pieces: no factor ties keys 7, b3 to a key"):
        optimise(poses, edges, [anchor(1, np.eye(4))])
    with pytest.raises(GraphError, match="factors on key 5 without an initial pose"):
        optimise(poses, [*edges, Edge(2, 5, STEP, TIGHT)], [anchor(1, np.eye(4))])
    _, values = optimise(poses, edges, [anchor(1, np.eye(4)), anchor(7, np.eye(4))])
    assert values.size() == 4


def test_marginals_are_those_of_the_chain_and_shrink_with_a_loop():
    truth = square_drive()
    same = {k: k for k in range(len(truth))}
    alone = optimise_all_scans(truth, same, {}, [], SETTINGS)
    (covariance,) = marginal_covariances(alone, [10])
    # ten equal steps along a line; the prior adds 1e-8 rad^2, which the lever of 10 m makes 1e-6
    step = invert(truth[0]) @ truth[10]
    np.testing.assert_allclose(covariance, chain_covariance(step, 10, SETTINGS), atol=2e-6)
    closed = optimise_all_scans(truth, same, {}, [loop_between(truth, 2, 84)], SETTINGS)
    loose, tight = marginal_covariances(alone, [84])[0], marginal_covariances(closed, [84])[0]
    assert np.trace(tight[3:, 3:]) < 0.1 * np.trace(loose[3:, 3:])
    assert marginal_covariances(alone, []).shape == (0, 6, 6)


def test_same_input_same_poses_to_the_bit():
    truth = square_drive()
    odometry = drifted(truth, DRIFT)
    same = {k: k for k in range(len(truth))}
    runs = []
    for _ in range(2):
        graph = built(odometry)
        for query in (80, 82, 84):
            graph.add_loop(loop_between(truth, query - 80, query))
        graph.settle()
        loops = graph.accepted_loops
        final = optimise_all_scans(odometry, same, graph.estimates(), loops, SETTINGS)
        runs.append((np.array(list(graph.estimates().values())), final.T_world_lidar))
    np.testing.assert_array_equal(runs[0][0], runs[1][0])
    np.testing.assert_array_equal(runs[0][1], runs[1][1])

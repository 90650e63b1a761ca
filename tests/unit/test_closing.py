"""Loops between keyframes of a simulated street corner, and the refusals."""

import numpy as np
import pytest

from sl3d_slam.closing import LoopCloser
from sl3d_slam.config import load_config
from sl3d_slam.geometry.se3 import (
    distance_m,
    from_yaw,
    invert,
    rotation_angle_rad,
    transform_points,
)
from sl3d_slam.graph.chain import OdometryChain
from sl3d_slam.types import LineSet, LoopConstraint, Rejection, View


@pytest.fixture(scope="module")
def keyframes(ring_dataset):
    """Scan 2, one on the far side of the block, and one a lap later, close to where 2 was."""
    scans = {k: next(ring_dataset.iterate(k, k + 1)).points_lidar for k in (2, 20, 46)}
    return scans, ring_dataset.truth


def closer_with(scans, T_odom_lidar, *overrides):
    """Return a closer that was given all scans, one step of odometry a scan."""
    closer, chain = new_closer(*overrides)
    last = 0
    for keyframe_id, (index, points) in enumerate(scans.items()):
        view, steps = closer.make_view(points), max(index - last, 1)
        add(closer, chain, keyframe_id, view, T_odom_lidar[index], steps)
        last = index
    return closer


def new_closer(*overrides):
    config = load_config(None, overrides)
    chain = OdometryChain(config.graph)
    return LoopCloser(config, chain), chain


def add(closer, chain, keyframe_id, view, T_odom_lidar, num_scans=1):
    chain.append(keyframe_id, T_odom_lidar, num_scans)
    closer.add(keyframe_id, view, T_odom_lidar)


def test_a_revisit_is_found_by_lines_alone_whichever_way_the_sensor_faces(keyframes):
    scans, truth = keyframes
    T_turned_lidar = from_yaw(np.radians(-137.0), np.zeros(3))
    turned = scans | {46: transform_points(T_turned_lidar, scans[46])}
    (loop,) = closer_with(turned, truth, "loops.max_candidates=1").search(2, {})
    assert isinstance(loop, LoopConstraint)
    assert (loop.query_id, loop.target_id) == (2, 0)
    T_truth = invert(truth[2]) @ truth[46] @ invert(T_turned_lidar)
    T_error = invert(T_truth) @ loop.T_target_query
    assert distance_m(T_error) < 0.2
    assert np.degrees(rotation_angle_rad(T_error)) < 1.0
    assert np.linalg.matrix_rank(loop.information) == 6
    assert loop.num_inliers >= 4


def test_across_a_block_only_poor_odometry_is_worth_a_loop(ring_dataset):
    """The views lie 21 m apart and 48 m of driving: good odometry knows better by then."""
    scans = {k: next(ring_dataset.iterate(k, k + 1)).points_lidar for k in (0, 24)}
    truth = ring_dataset.truth
    assert distance_m(invert(truth[0]) @ truth[24]) > 20.0
    assert closer_with(scans, truth, "loops.min_travel_m=20").search(1, {}) == []
    poor = "loops.min_travel_m=20", "graph.odometry_rotation_sigma_deg=0.3"
    (loop,) = closer_with(scans, truth, *poor).search(1, {})
    assert isinstance(loop, LoopConstraint)
    assert distance_m(invert(invert(truth[0]) @ truth[24]) @ loop.T_target_query) < 0.2
    near = (*poor, "loops.max_distance_m=15")
    assert closer_with(scans, truth, *near).search(1, {}) == []


def test_nothing_is_a_revisit_before_40_m_of_travel(keyframes):
    scans, truth = keyframes
    slow = {2: truth[2], 20: truth[2] @ from_yaw(0.0, np.array([30.0, 0, 0])), 46: truth[2]}
    closer, chain = new_closer()
    for keyframe_id, index in enumerate((2, 20)):
        add(closer, chain, keyframe_id, closer.make_view(scans[index]), slow[index])
    assert closer.search(0, {}) == []
    assert closer.search(1, {0: slow[2], 1: slow[2]}) == []


def test_a_candidate_by_estimate_that_does_not_fit_is_rejected_with_its_pose(keyframes):
    """The estimate says that the far side of the block is where the drive began."""
    scans, truth = keyframes
    odometry = {2: truth[2], 20: truth[2] @ from_yaw(0.0, np.array([50.0, 0, 0]))}
    closer, chain = new_closer("loops.min_votes=100000")
    for keyframe_id, index in enumerate((2, 20)):
        add(closer, chain, keyframe_id, closer.make_view(scans[index]), odometry[index])
    (outcome,) = closer.search(1, {0: truth[2], 1: truth[2]})
    assert isinstance(outcome, Rejection)
    assert (outcome.query_id, outcome.target_id) == (1, 0)
    assert outcome.reason
    assert outcome.T_target_query is not None


def test_a_scan_with_next_to_nothing_in_it_is_rejected_with_the_pose_it_was_tried_at():
    closer, chain = new_closer()
    nothing = LineSet(np.zeros((0, 2, 3)), np.zeros((0, 28), np.float32), np.zeros(0, np.int64))
    few = np.random.default_rng(0).uniform(-9, 9, (60, 3)).astype(np.float32)
    view = View(nothing, np.array([0.0, 0.0, 1.0]), few, np.ones(60, np.float32))
    poses = [np.eye(4), from_yaw(0.3, np.array([60.0, 0.0, 0.0]))]
    for keyframe_id, pose in enumerate(poses):
        add(closer, chain, keyframe_id, view, pose)
    there = from_yaw(0.1, np.array([2.0, 0.0, 0.0]))
    (outcome,) = closer.search(1, {0: np.eye(4), 1: there})
    assert isinstance(outcome, Rejection)
    assert "too few points" in outcome.reason
    np.testing.assert_allclose(outcome.T_target_query, there)


def test_what_is_kept_of_a_keyframe_is_its_view_to_the_centimetre(keyframes):
    scans, truth = keyframes
    closer, chain = new_closer()
    view = closer.make_view(scans[2])
    add(closer, chain, 5, view, truth[2])
    np.testing.assert_allclose(closer.view(5).cloud, view.cloud, atol=0.0051)
    np.testing.assert_array_equal(closer.view(5).lines.endpoints, view.lines.endpoints)
    np.testing.assert_array_equal(closer.view(5).lines.descriptors, view.lines.descriptors)

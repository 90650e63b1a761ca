"""Every two-pair pose: against brute force, and against a known yaw and shift among outliers."""

from itertools import combinations, permutations

import numpy as np
import pytest

from sl3d_slam.matching.consistency import (
    enumerate_poses,
    match_verticals,
    similarity,
    thin_poses,
)
from sl3d_slam.matching.verticals import Verticals

TOLERANCE_M, INLIER_M = 0.4, 0.6
POSE = np.array([np.radians(137.0), 12.0, -7.5])  # far from its own inverse


def verticals(xy, weights=None, descriptors=None):
    xy = np.asarray(xy, float).reshape(-1, 2)
    count = len(xy)
    return Verticals(
        xy=xy,
        heights=np.tile([-1.0, 2.0], (count, 1)),
        weights=np.ones(count) if weights is None else np.asarray(weights, float),
        descriptors=np.zeros((count, 0), np.float32) if descriptors is None else descriptors,
        indices=np.arange(count),
    )


def move(pose, xy):
    c, s = np.cos(pose[0]), np.sin(pose[0])
    return np.asarray(xy) @ np.array([[c, -s], [s, c]]).T + pose[1:]


def move_back(pose, xy):
    c, s = np.cos(pose[0]), np.sin(pose[0])
    return (np.asarray(xy) - pose[1:]) @ np.array([[c, -s], [s, c]])


def apart(rng, count, gap_m=3.0, half_m=40.0):
    """Places at least a gap apart, so that no point has two lines within the inlier distance."""
    places = []
    while len(places) < count:
        new = rng.uniform(-half_m, half_m, 2)
        if all(np.linalg.norm(new - old) > gap_m for old in places):
            places.append(new)
    return np.array(places)


def exact_score(pose, source, target):
    """The score by its definition, without a raster."""
    gap = np.linalg.norm(move(pose, source.xy)[:, None] - target.xy[None], axis=2)
    nearest = gap.argmin(axis=1)
    rows = np.arange(len(source))
    weight = np.sqrt(source.weights * target.weights[nearest])
    weight = weight * similarity(source, target)[rows, nearest]
    return float((weight * np.clip(1 - (gap[rows, nearest] / INLIER_M) ** 2, 0, None)).sum())


def two_point_pose(a, b, c, d):
    """The pose that lays the middle and the direction of (a, b) on those of (c, d)."""
    yaw = np.arctan2(*(d - c)[::-1]) - np.arctan2(*(b - a)[::-1])
    pose = np.array([np.arctan2(np.sin(yaw), np.cos(yaw)), 0.0, 0.0])
    pose[1:] = 0.5 * (c + d) - move(pose, 0.5 * (a + b))
    return pose


def brute_force(source, target):
    """All poses by plain loops, and their exact scores."""
    poses = []
    for i, j in combinations(range(len(source)), 2):
        for k, m in permutations(range(len(target)), 2):
            a, b, c, d = source.xy[i], source.xy[j], target.xy[k], target.xy[m]
            lengths = np.linalg.norm(b - a), np.linalg.norm(d - c)
            if min(lengths) > 3.0 and abs(lengths[0] - lengths[1]) <= TOLERANCE_M:
                poses.append(two_point_pose(a, b, c, d))
    return np.array(poses), np.array([exact_score(pose, source, target) for pose in poses])


def scene(rng, shared, extra, noise_m=0.03):
    """Target lines, and a source with ``shared`` of them (moved) and ``extra`` of its own."""
    target = apart(rng, shared + extra)
    own = apart(rng, extra)
    seen = move_back(POSE, target[:shared] + rng.normal(0, noise_m, (shared, 2)))
    order = rng.permutation(shared + extra)
    return verticals(np.concatenate([seen, own])[order]), verticals(target), order


def test_the_poses_and_scores_are_those_of_brute_force(rng):
    source, target, _ = scene(rng, 5, 3)
    poses, scores = enumerate_poses(source, target, TOLERANCE_M, INLIER_M)
    expected, expected_scores = brute_force(source, target)
    assert len(poses) == len(expected)
    order = np.argsort(-expected_scores, kind="stable")
    np.testing.assert_allclose(np.sort(scores)[::-1], expected_scores[order], atol=1e-5)  # float32
    np.testing.assert_allclose(poses[scores.argmax()], expected[order[0]], atol=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_a_known_pose_is_found_among_60_percent_outliers(seed):
    rng = np.random.default_rng(seed)
    source, target, _ = scene(rng, 10, 15)
    poses, scores = enumerate_poses(source, target, TOLERANCE_M, INLIER_M)
    best = poses[scores.argmax()]
    # 3 cm of noise on lines 20 m apart: a few milliradians, a few centimetres
    assert abs(np.angle(np.exp(1j * (best[0] - POSE[0])))) < 0.02
    np.testing.assert_allclose(best[1:], POSE[1:], atol=0.3)


@pytest.mark.parametrize("count", [0, 1])
def test_fewer_than_two_lines_propose_nothing(rng, count):
    few, many = verticals(apart(rng, count)), verticals(apart(rng, 9))
    for source, target in ((few, many), (many, few)):
        poses, scores = enumerate_poses(source, target, TOLERANCE_M, INLIER_M)
        assert poses.shape == (0, 3)
        assert scores.shape == (0,)


def test_two_lines_leave_the_choice_between_two_poses(rng):
    target = np.array([[3.0, 1.0], [9.0, -4.0]])
    poses, scores = enumerate_poses(
        verticals(move_back(POSE, target)), verticals(target), TOLERANCE_M, INLIER_M
    )
    np.testing.assert_allclose(scores, [2.0, 2.0], atol=1e-6)
    gaps = np.linalg.norm(poses - POSE, axis=1)
    assert gaps.min() < 1e-9
    assert gaps.max() > 1.0  # the other one is turned round


def test_lines_of_different_lengths_apart_propose_nothing():
    source, target = verticals([[0, 0], [10.0, 0]]), verticals([[0, 0], [10.0 + 0.41, 0]])
    assert len(enumerate_poses(source, target, TOLERANCE_M, INLIER_M)[0]) == 0


def test_matches_are_mutual_and_point_from_source_to_target(rng):
    source, target, order = scene(rng, 6, 4)
    matches = match_verticals(source, target, POSE, INLIER_M)
    true = {(int(row), int(k)) for row, k in enumerate(order) if k < 6}
    assert true <= {tuple(pair) for pair in matches.tolist()}
    assert len(set(matches[:, 0])) == len(set(matches[:, 1])) == len(matches)


def test_of_two_source_lines_near_one_target_line_the_nearer_gets_it():
    source, target = verticals([[0.3, 0.0], [0.1, 0.0]]), verticals([[0.0, 0.0]])
    assert match_verticals(source, target, np.zeros(3), INLIER_M).tolist() == [[1, 0]]


def test_nothing_matches_at_the_inlier_distance_or_with_an_empty_side():
    one = verticals([[0.0, 0.0]])
    assert len(match_verticals(one, verticals([[0.6, 0.0]]), np.zeros(3), 0.6)) == 0
    for pair in ((one, verticals([])), (verticals([]), one)):
        assert match_verticals(*pair, np.zeros(3), 0.6).shape == (0, 2)


def test_descriptors_weigh_but_never_forbid():
    axes = np.eye(3, dtype=np.float32)
    source = verticals(np.zeros((2, 2)), descriptors=axes[:2])
    target = verticals(np.zeros((2, 2)), descriptors=np.stack([axes[0], -axes[1]]))
    np.testing.assert_allclose(similarity(source, target), [[1.0, 0.3], [0.3, 0.3]], atol=1e-6)
    np.testing.assert_array_equal(similarity(verticals(np.zeros((2, 2))), target), np.ones((2, 2)))


def test_thinning_keeps_the_best_of_each_cell_in_order():
    poses = np.array([[0.01, 0.6, 0.1], [0.01, 0.1, 0.1], [1.0, 0.1, 0.1], [0.02, 0.2, 0.3]])
    scores = np.array([2.0, 4.0, 1.0, 3.0])
    kept, kept_scores = thin_poses(poses, scores, limit=10)
    assert kept_scores.tolist() == [4.0, 2.0, 1.0]
    np.testing.assert_array_equal(kept, poses[[1, 0, 2]])
    assert thin_poses(poses, scores, limit=2)[1].tolist() == [4.0, 2.0]


def test_thinning_looks_as_far_as_it_must_and_ties_keep_their_order(rng):
    crowd = np.tile([0.01, 0.1, 0.1], (200, 1))  # the best 200 share a cell
    lone = np.c_[np.zeros(30), 5.25 + np.arange(30), np.full(30, 0.25)]
    order = rng.permutation(230)
    poses = np.concatenate([crowd, lone])[order]
    scores = np.r_[np.full(200, 9.0), np.repeat([3.0, 2.0, 1.0], 10)][order]
    kept, kept_scores = thin_poses(poses, scores, limit=15)
    assert kept_scores.tolist() == [9.0, *[3.0] * 10, *[2.0] * 4]
    second = poses[scores == 2.0]
    np.testing.assert_array_equal(kept[11:], second[:4])

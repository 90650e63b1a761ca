"""GICP on coarse clouds: the known pose, and what its information says about the source frame."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sl3d_slam.geometry.se3 import exp, invert, log, make_transform, skew, transform_points
from sl3d_slam.geometry.surface_fit import SurfaceFit
from sl3d_slam.matching.dense import (
    MIN_SIGMAS,
    USUAL_MISFIT,
    align,
    coarse_cloud,
    information_of,
    prepare,
    thin,
)

T_TARGET_SOURCE = make_transform(
    Rotation.from_euler("zyx", [137.0, 2.0, -3.0], degrees=True).as_matrix(),
    np.array([6.0, -3.0, 0.4]),
)
NUDGE = exp(np.array([0.01, -0.02, 0.04, 0.5, -0.4, 0.2]))


def fit_of(hessian, misfit=USUAL_MISFIT, support=0.5):
    return SurfaceFit(np.eye(4), hessian, misfit, support, rests=True)


def yard(rng, count=12_000):
    """The floor, two walls at an angle and a box."""
    a, b = rng.uniform(0, 1, (2, count))
    part = rng.integers(0, 4, count)
    floor = np.c_[40 * a - 20, 40 * b - 20, np.full(count, -1.7)]
    wall = np.c_[40 * a - 20, np.full(count, 20.0), 6 * b - 1.7]
    slanted = np.c_[20 - 8 * a, 40 * a - 20, 6 * b - 1.7]
    box = np.c_[-8 + 4 * a, np.full(count, 5.0), 3 * b - 1.7]
    return np.choose(part[:, None], [floor, wall, slanted, box])


def ground_ahead(rng, count=6000):
    """Level ground, but only between 20 and 40 m in front of the source."""
    return np.c_[rng.uniform(20, 40, count), rng.uniform(-10, 10, count), np.full(count, -1.7)]


def clouds(make, T_target_source):
    target = transform_points(T_target_source, make(np.random.default_rng(1)))
    source = make(np.random.default_rng(2))
    return prepare(coarse_cloud(target, 0.5)), thin(coarse_cloud(source, 0.5))


def test_a_known_pose_is_recovered_from_a_nudged_one():
    target, source = clouds(yard, T_TARGET_SOURCE)
    aligned = align(target, source, T_TARGET_SOURCE @ NUDGE)
    error = log(invert(T_TARGET_SOURCE) @ aligned.fit.T_target_source)
    assert np.linalg.norm(error[:3]) < np.radians(0.2)  # different samples of the same surfaces
    assert np.linalg.norm(error[3:]) < 0.05
    assert aligned.overlap > 0.9


def test_alignment_is_the_same_every_time():
    target, source = clouds(yard, T_TARGET_SOURCE)
    first, second = (align(target, source, T_TARGET_SOURCE @ NUDGE) for _ in range(2))
    np.testing.assert_array_equal(first.fit.T_target_source, second.fit.T_target_source)
    np.testing.assert_array_equal(first.fit.hessian, second.fit.hessian)


def test_information_speaks_of_a_step_on_the_right_in_the_source_frame_rotation_first():
    """Ground 20-40 m ahead of the source: pitching there is heaving, with a sign."""
    target, source = clouds(ground_ahead, T_TARGET_SOURCE)
    hessian = align(target, source, T_TARGET_SOURCE).fit.hessian
    points = coarse_cloud(ground_ahead(np.random.default_rng(2)), 0.5).astype(float)
    up = np.array([0.0, 0.0, 1.0])
    rows = np.array([up @ np.hstack([-skew(p), np.eye(3)]) for p in points])
    expected = rows.T @ rows
    found = hessian / hessian[5, 5]
    expected /= expected[5, 5]
    for i, j in ((1, 1), (1, 5), (0, 0), (5, 5)):
        assert found[i, j] == pytest.approx(expected[i, j], rel=0.1)
    assert found[1, 5] < -20  # metres: nose down lifts what lies ahead
    assert np.abs(found[3:5, 3:5]).max() < 0.01  # sliding and turning on the ground is free
    assert found[2, 2] < 0.01 * found[1, 1]


def test_free_directions_stay_zero_and_fixed_ones_are_bounded():
    turn = make_transform(Rotation.from_euler("z", 40, degrees=True).as_matrix(), np.zeros(3))
    axis = turn[:3, 0]
    hessian = np.diag([1e9, 1e9, 1e9, 0, 0, 0.0])
    hessian[3:, 3:] = 1e7 * (np.eye(3) - np.outer(axis, axis))
    information = information_of(fit_of(hessian))
    free = np.r_[0, 0, 0, axis]
    np.testing.assert_allclose(information @ free, 0.0, atol=1e-6)
    assert np.linalg.matrix_rank(information) == 5
    assert information[0, 0] <= MIN_SIGMAS[0] ** -2
    assert information[5, 5] <= MIN_SIGMAS[5] ** -2
    np.testing.assert_allclose(information, information.T)


def corridor(rng, count=20_000):
    """The floor and two walls of a long bare street."""
    a, b = rng.uniform(0, 1, (2, count))
    part = rng.integers(0, 3, count)
    floor = np.c_[120 * a - 60, 16 * b - 8, np.full(count, -1.7)]
    left, right = (np.c_[120 * a - 60, np.full(count, y), 6 * b - 1.7] for y in (8.0, -8.0))
    return np.choose(part[:, None], [floor, left, right])


def test_along_a_bare_corridor_nothing_is_held():
    """GICP itself ends wherever it started, and its Hessian would vouch for it."""
    target, source = clouds(corridor, T_TARGET_SOURCE)
    information = information_of(align(target, source, T_TARGET_SOURCE).fit)
    assert np.linalg.matrix_rank(information) == 5
    along, across = information[3, 3], information[4, 4]  # the corridor runs along the source's x
    assert along < 0.01 * across


def test_more_evidence_never_means_less_information():
    weak, strong = (
        information_of(fit_of(scale * np.diag([1e6] * 3 + [1e4] * 3))) for scale in (1.0, 10.0)
    )
    assert np.linalg.eigvalsh(strong - weak).min() > 0


def test_too_few_points_are_refused_rather_than_answered_with_the_identity(rng):
    assert prepare(rng.uniform(-10, 10, (99, 3)).astype(np.float32)) is None
    assert prepare(np.zeros((0, 3), np.float32)) is None
    assert prepare(rng.uniform(-10, 10, (100, 3)).astype(np.float32)) is not None


def test_a_coarse_cloud_has_one_mean_a_voxel_and_nothing_far(rng):
    near = np.array([[10.1, 0.1, 0.1], [10.3, 0.1, 0.1], [30.1, 0.1, 0.1], [71.0, 0.0, 0.0]])
    cloud = coarse_cloud(near, 0.5)
    order = np.argsort(cloud[:, 0])
    np.testing.assert_allclose(cloud[order], [[10.2, 0.1, 0.1], [30.1, 0.1, 0.1]], atol=1e-6)
    assert coarse_cloud(np.zeros((0, 3)), 0.5).shape == (0, 3)


def test_surfaces_that_lie_badly_on_each_other_say_less():
    hessian = np.diag([1e4] * 3 + [1e3] * 3)
    good, bad = (information_of(fit_of(hessian, misfit=misfit)) for misfit in (0.1, 0.2))
    # twice the misfit, sixteen times the noise, and more where that leaves a direction loose
    assert np.all(np.diag(good) / np.diag(bad) > 15.0)


def test_what_is_held_loosely_errs_by_more_than_noise():
    tight, loose = (
        information_of(fit_of(np.diag([1e6, 1e6, 1e6, 1e4, 1e4, held])))[5, 5]
        for held in (1e4, 1e2)
    )
    assert tight > 150.0 * loose  # noise alone would say a hundredfold


def test_views_that_share_little_say_less():
    hessian = np.diag([1e4] * 3 + [1e3] * 3)
    much, half, little = (
        np.diag(information_of(fit_of(hessian, support=support))) for support in (0.5, 0.25, 0.1)
    )
    assert np.all(half > 0.6 * much)
    assert np.all(little < 0.3 * much)


def test_the_misfit_of_an_alignment_grows_with_the_roughness_of_surfaces():
    def rough(rng):
        return yard(rng) + rng.normal(0.0, 0.1, (12_000, 3))

    smooth = align(*clouds(yard, T_TARGET_SOURCE), T_TARGET_SOURCE)
    assert (
        align(*clouds(rough, T_TARGET_SOURCE), T_TARGET_SOURCE).fit.misfit > 1.5 * smooth.fit.misfit
    )

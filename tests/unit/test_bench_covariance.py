"""The measure of honesty itself: six for honest noise, more for noise that is larger."""

from itertools import pairwise

import numpy as np
import pytest

from sl3d_slam.bench.covariance import CovarianceBench, _pairs, step_errors
from sl3d_slam.config import GraphSettings, SlamConfig
from sl3d_slam.geometry.se3 import exp, invert, make_transform
from sl3d_slam.graph.noise import step_covariance

CONFIG = SlamConfig(
    graph=GraphSettings(odometry_rotation_sigma_deg=0.05, odometry_translation_sigma_m=0.02)
)
STEP = exp(np.array([0.0, 0.01, 0.05, 1.2, 0.1, 0.0]))


def drive(num_scans):
    poses = [np.eye(4)]
    while len(poses) < num_scans:
        poses.append(poses[-1] @ STEP)
    return np.array(poses)


@pytest.mark.parametrize("excess", [1.0, 2.0])
def test_honest_steps_measure_six(rng, excess):
    truth = drive(600)
    sigmas = excess * np.sqrt(np.diag(step_covariance(STEP, CONFIG.graph)))
    odometry = [truth[0]]
    for before, after in pairwise(truth):
        noise = exp(sigmas * rng.standard_normal(6))
        odometry.append(odometry[-1] @ invert(before) @ after @ noise)
    errors, squared = step_errors(np.array(odometry), truth, CONFIG)
    assert len(errors) == len(squared) == 597
    # the mean of 597 chi-squares of six degrees of freedom spreads by 0.14
    assert squared.mean() == pytest.approx(6.0 * excess**2, rel=0.1)
    np.testing.assert_allclose(errors.std(axis=0), sigmas, rtol=0.15)


def test_pairs_are_near_in_space_and_far_along_the_way():
    """Out along x and back, 10 m apart each: only places met twice, 40 m of way between."""
    x = [0.0, 10.0, 20.0, 30.0, 40.0, 50.0, 40.0, 30.0, 20.0, 10.0]
    truth = np.array([make_transform(np.eye(3), np.array([value, 0.0, 0.0])) for value in x])
    config = SlamConfig().model_copy(
        update={"loops": SlamConfig().loops.model_copy(update={"max_distance_m": 5.0})}
    )
    pairs = _pairs(range(10), truth, CovarianceBench([], config))
    assert sorted(map(tuple, pairs.tolist())) == [(1, 9), (2, 8)]

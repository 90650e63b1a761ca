"""Covariances of odometry: what a pose's alignment says, and how two poses make a step."""

import numpy as np
import pytest

from sl3d_slam.config import GraphSettings
from sl3d_slam.geometry.se3 import exp, invert, log
from sl3d_slam.graph.final import odometry_edges
from sl3d_slam.graph.noise import step_covariance
from sl3d_slam.journal import Journal
from sl3d_slam.odometry.noise import pose_covariance
from sl3d_slam.types import RegisteredScan

HESSIAN = np.diag([4e7, 6e7, 9e7, 9e4, 1.6e5, 2.5e5])
STEP = exp(np.array([0.02, -0.03, 0.3, 1.0, 0.4, -0.1]))  # not its own inverse in any coordinate


def test_worse_surfaces_mean_a_larger_covariance_in_every_direction():
    small, usual, large = (pose_covariance(HESSIAN, misfit) for misfit in (0.08, 0.1, 0.15))
    assert np.linalg.eigvalsh(usual - small)[0] > 0
    assert np.linalg.eigvalsh(large - usual)[0] > 0


def test_a_direction_held_worse_is_less_certain():
    sigmas = np.sqrt(np.diag(pose_covariance(HESSIAN, 0.1)))
    assert sigmas[3] > sigmas[4] > sigmas[5]


@pytest.mark.parametrize("misfit", [0.0, 0.1, 10.0])
def test_a_scan_that_shows_nothing_has_a_finite_covariance(misfit):
    covariance = pose_covariance(np.zeros((6, 6)), misfit)
    np.testing.assert_array_equal(covariance, covariance.T)
    assert np.isfinite(covariance).all()
    assert np.linalg.eigvalsh(covariance)[0] > 0


def test_a_step_errs_as_both_its_ends_do(rng):
    """Sampled: each pose off by its own noise at its own frame, the step's error at the newer."""
    before = np.diag(np.array([1e-3, 2e-3, 4e-3, 0.03, 0.01, 0.02]) ** 2)
    after = np.diag(np.array([3e-3, 1e-3, 2e-3, 0.01, 0.04, 0.01]) ** 2)
    poses = np.array([np.eye(4), STEP])
    (edge,) = odometry_edges(poses, GraphSettings(), [before, after])
    errors = []
    for xi in rng.standard_normal((1000, 2, 6)):
        first = exp(np.sqrt(np.diag(before)) * xi[0])
        second = STEP @ exp(np.sqrt(np.diag(after)) * xi[1])
        errors.append(log(invert(STEP) @ invert(first) @ second))
    covariance = np.linalg.inv(edge.information)
    scale = np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)))
    # 1,000 samples fix a correlation to 1 / sqrt(1000) = 0.032; five times that
    np.testing.assert_allclose(np.cov(np.array(errors).T) / scale, covariance / scale, atol=0.16)


def test_where_a_covariance_is_not_known_the_settings_speak():
    poses = np.array([np.eye(4), STEP, STEP @ STEP])
    edges = odometry_edges(poses, GraphSettings(), [None, np.eye(6), np.eye(6)])
    expected = np.linalg.inv(step_covariance(STEP, GraphSettings()))
    np.testing.assert_allclose(edges[0].information, expected, rtol=1e-9)
    assert edges[1].information.max() < 2.0


def test_a_resumed_run_has_the_covariance_that_was_noted():
    journal, covariance = Journal(), pose_covariance(HESSIAN, 0.1)
    scan = RegisteredScan(0, 0.0, np.zeros((5, 3)), STEP, covariance)
    assert journal.note_scan(0, scan) is scan
    again = journal.note_scan(0, RegisteredScan(0, 0.0, np.zeros((5, 3)), STEP))
    np.testing.assert_array_equal(again.covariance, covariance)
    np.testing.assert_array_equal(journal.pose(0), STEP)

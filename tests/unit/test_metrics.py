"""Trajectory measures against errors made by hand."""

import importlib.util
import subprocess
import sys
from itertools import pairwise

import numpy as np
import pytest

from sl3d_slam.errors import InputError
from sl3d_slam.geometry.se3 import exp, from_yaw, invert
from sl3d_slam.report.metrics import align, ate_rmse_m, count_false_loops, kitti_errors
from sl3d_slam.types import LoopRecord

STEP_M = 1.0


def winding_drive(num_poses=1200, scale=1.0, extra_yaw_deg_per_m=0.0):
    """A drive of 1 m steps through bends and slopes; scale and yaw spoil each step."""
    poses = [from_yaw(0.7, np.array([3.0, -2.0, 1.0]))]
    for i in range(num_poses - 1):
        turn = [0.0, 0.004 * np.sin(i / 60.0), 0.02 * np.sin(i / 45.0)]
        T_last_next = exp(np.array([*turn, scale * STEP_M, 0.0, 0.0]))
        T_last_next = T_last_next @ from_yaw(np.radians(extra_yaw_deg_per_m * STEP_M), np.zeros(3))
        poses.append(poses[-1] @ T_last_next)
    return np.array(poses)


def straight_drive(num_poses, scale=1.0, extra_yaw_deg_per_m=0.0):
    poses = [np.eye(4)]
    T_last_next = from_yaw(np.radians(extra_yaw_deg_per_m), np.array([scale * STEP_M, 0.0, 0.0]))
    for _ in range(num_poses - 1):
        poses.append(poses[-1] @ T_last_next)
    return np.array(poses)


def test_align_recovers_a_known_transform(rng):
    T_a_b = from_yaw(2.5, np.array([10.0, -4.0, 3.0])) @ exp(np.array([0.4, -0.3, 0.0, 0, 0, 0]))
    points_b = rng.normal(size=(30, 3))
    points_a = points_b @ T_a_b[:3, :3].T + T_a_b[:3, 3]
    np.testing.assert_allclose(align(points_b, points_a), T_a_b, atol=1e-12)


def test_rigid_offset_changes_nothing():
    truth = winding_drive()
    T_odom_world = from_yaw(-1.9, np.array([50.0, 8.0, -2.0]))
    estimate = T_odom_world @ truth
    assert ate_rmse_m(estimate, truth) == pytest.approx(0.0, abs=1e-9)
    assert kitti_errors(estimate, truth) == pytest.approx((0.0, 0.0), abs=1e-5)


def test_ate_of_alternating_offset_is_the_offset():
    # +-0.3 m sideways in turn on a straight path: no rigid motion removes any of it.
    truth = straight_drive(1000)
    estimate = truth.copy()
    estimate[::2, 1, 3] += 0.3
    estimate[1::2, 1, 3] -= 0.3
    # 1e-5: the alignment may turn by the tiny correlation of the pattern with the path.
    assert ate_rmse_m(estimate, truth) == pytest.approx(0.3, abs=1e-5)


def test_ate_does_not_forgive_scale():
    # n evenly spaced points scaled by 1.01 about their centre: 0.01 * std of the positions.
    truth = straight_drive(401)
    estimate = straight_drive(401, scale=1.01)
    expected = 0.01 * np.std(np.arange(401.0))
    assert ate_rmse_m(estimate, truth) == pytest.approx(expected, rel=1e-9)


def test_ate_does_not_mirror():
    truth = winding_drive()
    mirrored = truth.copy()
    mirrored[:, 1, 3] *= -1.0
    assert ate_rmse_m(mirrored, truth) > 5.0


def test_scale_error_is_that_many_percent():
    # Each stretch is one step longer than its name, as in the kit: 101/100 ... 801/800.
    truth, estimate = straight_drive(2000), straight_drive(2000, scale=1.02)
    translation, rotation = kitti_errors(estimate, truth)
    assert 2.0 < translation < 2.0 * 1.01 + 1e-9
    assert rotation == pytest.approx(0.0, abs=1e-6)


def test_scale_error_on_a_winding_drive_is_near_that_many_percent():
    translation, _ = kitti_errors(winding_drive(scale=1.02), winding_drive())
    # Chords are shorter than the path, so the error per metre of path is below 2 percent.
    assert 1.5 < translation < 2.02


def test_yaw_drift_is_its_rate():
    truth = straight_drive(1500)
    estimate = straight_drive(1500, extra_yaw_deg_per_m=0.01)
    translation, rotation = kitti_errors(estimate, truth)
    # One step more than the length, as above: at most 1 percent.
    assert 0.01 < rotation < 0.0101 + 1e-9
    # An arc that turns by a over s metres ends s * a / 2 aside: 0.87 % at 100 m, 7 % at 800 m.
    assert 0.8 < translation < 7.0


def test_kitti_errors_against_a_plain_reading_of_the_definition(rng):
    truth = winding_drive(400)
    noise = np.array([exp(rng.normal(0.0, 0.01, 6)) for _ in truth])
    estimate = np.array([T @ E for T, E in zip(truth, noise, strict=True)])
    steps = [np.linalg.norm(b[:3, 3] - a[:3, 3]) for a, b in pairwise(truth)]
    travelled = np.concatenate([[0.0], np.cumsum(steps)])
    errors = []
    for first in range(0, 400, 10):
        for length in range(100, 900, 100):
            after = [i for i in range(400) if travelled[i] > travelled[first] + length]
            if after:
                T_error = invert(invert(estimate[first]) @ estimate[after[0]]) @ (
                    invert(truth[first]) @ truth[after[0]]
                )
                angle = np.degrees(np.arccos((np.trace(T_error[:3, :3]) - 1.0) / 2.0))
                errors.append((100 * np.linalg.norm(T_error[:3, 3]) / length, angle / length))
    assert kitti_errors(estimate, truth) == pytest.approx(np.mean(errors, axis=0), rel=1e-6)


def test_short_path_has_no_kitti_errors():
    assert kitti_errors(straight_drive(100), straight_drive(100)) is None  # 99 m
    assert kitti_errors(straight_drive(102), straight_drive(102)) is not None  # 101 m


@pytest.mark.parametrize("measure", [ate_rmse_m, kitti_errors])
def test_unpaired_trajectories_are_refused(measure):
    with pytest.raises(InputError, match="found 4 for 3"):
        measure(straight_drive(3), straight_drive(4))
    with pytest.raises(InputError, match="found 0 for 0"):
        measure(np.empty((0, 4, 4)), np.empty((0, 4, 4)))


def test_one_pose_has_no_error():
    pose = from_yaw(1.0, np.array([5.0, 2.0, 1.0]))[None]
    assert ate_rmse_m(pose, np.eye(4)[None]) == pytest.approx(0.0, abs=1e-12)


def test_false_loops_are_those_far_from_the_truth():
    truth = winding_drive(300)

    def loop(status, T_error):
        T_target_query = invert(truth[20]) @ truth[250] @ T_error
        return LoopRecord(250, 20, T_target_query, 9, status, "")

    good = loop("accepted", from_yaw(np.radians(4.0), np.array([1.9, 0.0, 0.0])))
    far = loop("accepted", from_yaw(0.0, np.array([0.0, 2.1, 0.0])))
    turned = loop("accepted", from_yaw(np.radians(6.0), np.zeros(3)))
    rejected = loop("rejected", from_yaw(1.0, np.full(3, 30.0)))
    backwards = LoopRecord(250, 20, invert(good.T_target_query), 9, "accepted", "")
    assert count_false_loops([good, rejected], truth) == 0
    assert count_false_loops([good, far, turned, rejected, backwards], truth) == 3


@pytest.mark.skipif(importlib.util.find_spec("evo") is None, reason="evo is not installed")
def test_ate_agrees_with_evo(tmp_path, rng):
    truth = winding_drive(200)
    estimate = truth @ np.array([exp(rng.normal(0.0, 0.02, 6)) for _ in truth])
    for name, poses in (("truth", truth), ("estimate", estimate)):
        np.savetxt(tmp_path / f"{name}.txt", poses[:, :3].reshape(-1, 12))
    command = [sys.executable, "-m", "evo.main_ape", "kitti", "truth.txt", "estimate.txt", "-a"]
    answer = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
    rmse = next(line.split()[1] for line in answer.stdout.splitlines() if "rmse" in line)
    assert ate_rmse_m(estimate, truth) == pytest.approx(float(rmse), abs=2e-6)  # six digits

"""Calibrated probabilities are odds, and the order of points is as before."""

import numpy as np
import pytest
import torch

from sl3d_slam.errors import InputError
from sl3d_slam.learning.calibration import (
    calibrate,
    calibration_error,
    fit_odds,
    log_odds,
    probability_of,
)
from sl3d_slam.learning.joint_validation import look_at
from sl3d_slam.learning.prepared import PreparedDrive, PreparedScan
from sl3d_slam.lines.network.model import SuperLine3D
from sl3d_slam.lines.network.settings import NetworkSettings
from sl3d_slam.lines.network.weights_file import load_weights, read_about, save_weights
from sl3d_slam.simulation.drive import plan_drive
from sl3d_slam.simulation.roads import Road
from sl3d_slam.simulation.town import build_town
from sl3d_slam.simulation.write import Layout, write_drive


def test_the_distortion_of_odds_is_found(rng):
    honest = rng.normal(-2.0, 2.0, 40_000)
    truth = rng.random(40_000) < probability_of(honest)
    slope, shift = fit_odds((honest + 1.7) / 0.8, truth)  # too high and too sure
    assert slope == pytest.approx(0.8, abs=0.03)  # three standard errors of the fit
    assert shift == pytest.approx(-1.7, abs=0.06)


def test_error_is_the_gap_between_probability_and_share(rng):
    truth = np.arange(1000) % 10 < 2
    assert calibration_error(np.full(1000, 0.2), truth) == pytest.approx(0.0, abs=1e-9)
    assert calibration_error(np.full(1000, 0.9), truth) == pytest.approx(0.7)
    assert np.isfinite(log_odds(np.array([0.0, 1.0]))).all()


@pytest.fixture
def drive(rng):
    """Posts of an eighth of the points among clutter, in five scans that look alike."""
    scans = []
    for _ in range(10):
        posts = [
            np.c_[np.tile(rng.uniform(-12, 12, 2), (15, 1)), rng.uniform(0, 3, 15)]
            for _ in range(6)
        ]
        points = np.concatenate([*posts, rng.uniform([-12, -12, 0], [12, 12, 2], (600, 3))])
        ids = np.r_[np.repeat(np.arange(6), 15), np.full(600, -1)].astype(np.int32)
        ids[-20:] = -2
        cloud = np.c_[points, points[:, 2]].astype(np.float32)
        scans.append(
            PreparedScan(cloud, ids, np.zeros((6, 2, 3), np.float32), np.ones(6, np.uint8))
        )
    return PreparedDrive("posts", True, np.tile(np.eye(4), (10, 1, 1)), tuple(scans))


def new_model():
    torch.manual_seed(3)
    return SuperLine3D(NetworkSettings(width=8, descriptor_dim=8, num_neighbours=6, stride=1))


def test_probabilities_become_shares_and_keep_their_order(drive):
    model = new_model()
    before = look_at(model, drive.scans[0])
    found = calibrate(model, [drive])
    after = look_at(model, drive.scans[0])
    # a network that learned nothing says about one half of all points, and one in eight is right
    assert found.error_after < 0.1 < 0.3 < found.error_before
    share = np.mean(np.concatenate([s.line_ids[s.line_ids > -2] >= 0 for s in drive.scans[::5]]))
    assert after.line_probability.mean() == pytest.approx(share, abs=0.05)
    np.testing.assert_array_equal(before.descriptors, after.descriptors)
    order = np.argsort(before.line_probability, kind="stable")
    assert (np.diff(after.line_probability[order]) >= -1e-6).all()


def test_a_network_that_is_wrong_way_round_is_refused(drive):
    model = new_model()
    with torch.no_grad():
        model.segmentation[-1].weight.neg_()
    with pytest.raises(InputError, match="less sure where its lines are"):
        calibrate(model, [drive])


def test_drives_without_lines_are_refused(drive):
    bare = [PreparedScan(s.points, np.full_like(s.line_ids, -1), s.endpoints, s.kinds)
            for s in drive.scans]  # fmt: skip
    model = SuperLine3D(NetworkSettings(width=8, num_neighbours=6))
    with pytest.raises(InputError, match="posts: expected points on lines"):
        calibrate(model, [PreparedDrive("posts", True, drive.T_world_lidar, tuple(bare))])


def test_the_verb_leaves_weights_that_say_how(sl3d, tmp_path):
    way = 5.0 * np.arange(5)
    bend = np.column_stack([way, 0.004 * way**2, np.zeros(5), np.arctan(0.008 * way)])
    planned = plan_drive(build_town(Road("bend", bend), 63), "hdl32")
    town = write_drive(planned, Layout(tmp_path / "town", "63"))
    model = new_model()
    save_weights(tmp_path / "raw.safetensors", model, {"step": "7"})
    out = tmp_path / "calibrated.safetensors"
    result = sl3d("train", "calibrate", tmp_path / "raw.safetensors", town,
                  "--out", out, "--cache", tmp_path / "cache")  # fmt: skip
    assert result.returncode == 0, result.stderr
    about = read_about(out)
    assert about["about.step"] == "7"
    assert "slope" in about["about.calibrated"]
    pairs = zip(model.state_dict().items(), load_weights(out).state_dict().values(), strict=True)
    changed = {name for (name, value), other in pairs if not torch.equal(value, other)}
    assert changed == {"segmentation.2.weight", "segmentation.2.bias"}

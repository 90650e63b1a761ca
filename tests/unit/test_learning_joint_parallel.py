"""Joint training in two processes, and from a raw drive to weights that beat chance."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest
import torch

from sl3d_slam.learning.joint_run import JointPlan, start_model, train_joint
from sl3d_slam.learning.joint_settings import JointSettings
from sl3d_slam.lines.network.settings import NetworkSettings
from sl3d_slam.lines.network.weights_file import load_weights, read_about
from sl3d_slam.simulation.drive import plan_drive
from sl3d_slam.simulation.roads import Road
from sl3d_slam.simulation.town import build_town
from sl3d_slam.simulation.write import Layout, write_drive

pytestmark = pytest.mark.slow

SMALL = NetworkSettings(width=8, descriptor_dim=8, num_neighbours=8, stride=1)
SCRIPT = """
import json, sys
from pathlib import Path
import torch
from sl3d_slam.learning.joint_run import JointPlan, train_joint
from sl3d_slam.learning.joint_settings import JointSettings
from sl3d_slam.lines.network.settings import NetworkSettings
torch.set_num_threads(1)
data, out, settings, network = sys.argv[1:]
plan = JointPlan((Path(data),), Path(out), checkpoint_every=2)
train_joint(
    plan, JointSettings.model_validate_json(settings), NetworkSettings.model_validate_json(network)
)
"""


def bend(count, step_m):
    s = step_m * np.arange(count)
    return np.column_stack([s, 0.004 * s**2, np.zeros(count), np.arctan(0.008 * s)])


def town(folder, seed, count, step_m, sensor="hdl32"):
    drive = plan_drive(build_town(Road("bend", bend(count, step_m)), seed), sensor)
    return write_drive(drive, Layout(folder, sequence=f"{seed}"))


def test_two_processes_learn_what_one_does_from_twice_the_pairs(tmp_path):
    data = town(tmp_path / "town", 53, 6, 5.0)
    alone = JointSettings(steps=3, points=2000, pairs_per_step=2, warmup_steps=1)
    together = JointSettings(steps=3, points=2000, pairs_per_step=1, warmup_steps=1)
    one = train_joint(JointPlan((data,), tmp_path / "one", checkpoint_every=2), alone, SMALL)
    script = tmp_path / "train.py"
    script.write_text(SCRIPT)
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone"]
    command += ["--nproc-per-node", "2", str(script), str(data), str(tmp_path / "two")]
    command += [together.model_dump_json(), SMALL.model_dump_json()]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    result = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=300)
    assert result.returncode == 0, result.stderr
    two = load_weights(tmp_path / "two" / "weights.safetensors").state_dict()
    begin = start_model(SMALL, alone, None).state_dict()
    moved = torch.cat([(value - begin[n]).ravel() for n, value in one.state_dict().items()])
    apart = torch.cat([(value - two[n]).ravel() for n, value in one.state_dict().items()])
    # the same gradients, summed in another order; Adam turns rounding of tiny ones into steps
    assert apart.abs().mean() < 0.02 * moved.abs().mean()
    assert len((tmp_path / "two" / "curves.csv").read_text().splitlines()) == 4


def test_minutes_of_training_beat_chance_on_a_town_never_seen(tmp_path):
    """The short version of the shipped training: three towns, a few minutes on two cores."""
    training = [town(tmp_path / f"t{seed}", seed, 16, 3.0, "hdl64") for seed in (54, 55, 56)]
    unseen = town(tmp_path / "unseen", 57, 16, 3.0, "hdl64")
    plan = JointPlan(tuple(training), tmp_path / "run", held_out=(unseen,), checkpoint_every=250)
    train_joint(plan, JointSettings(steps=250, warmup_steps=30), NetworkSettings(stride=1))
    rows = (tmp_path / "run" / "validation.csv").read_text().splitlines()
    look = dict(zip(*(row.split(",") for row in rows), strict=True))
    # all points called lines would give an F1 of some 0.14
    assert float(look["best_f1"]) > 0.35
    assert float(look["five_10m"]) > 3.0 * float(look["chance_five"])
    assert float(look["five_20m"]) > 1.5 * float(look["chance_five"])


def test_the_verb_trains_and_goes_on(sl3d, tmp_path):
    data = town(tmp_path / "town", 58, 4, 5.0)
    options = ["--out", tmp_path / "run", "--points", 800, "--checkpoint-every", 1, "--seed", 3]
    result = sl3d("train", "joint", data, *options, "--steps", 2)
    assert result.returncode == 0, result.stderr
    about = read_about(tmp_path / "run" / "weights.safetensors")
    assert json.loads(about["about.run"])["settings"]["seed"] == 3
    again = sl3d("train", "joint", data, *options, "--steps", 3, "--resume")
    assert again.returncode == 2
    assert "made with other settings" in again.stderr

"""The towns of the shipped weights: which roads they are on, and that they can be made."""

import json

import numpy as np
import pytest

from sl3d_slam.errors import InputError
from sl3d_slam.learning.towns import HELD_OUT, TOWNS, TownPlan, every_three_metres, simulate_towns


def write_poses(path, places):
    """Camera poses (x right, y down, z forward) without turns."""
    rows = np.tile(np.eye(4)[:3].ravel(), (len(places), 1))
    rows[:, [3, 7, 11]] = places
    np.savetxt(path, rows)


def test_places_are_three_metres_of_way_apart(rng):
    way = np.cumsum(rng.uniform(0.2, 1.0, 200))
    turn = 0.02 * way
    places = 50.0 * np.column_stack([np.sin(turn), 0 * turn, 1 - np.cos(turn)])
    chosen = every_three_metres(places, 20)
    assert len(chosen) == 20
    steps = np.diff(way[chosen])
    assert (steps >= 2.9).all()
    assert (steps <= 4.0).all()  # a step of the drive more
    assert every_three_metres(np.zeros((5, 3)), 4) == [0]


def test_no_town_is_a_test_town_and_none_comes_twice():
    seeds = [plan.seed for plan in (*TOWNS, HELD_OUT)]
    assert len(set(seeds)) == len(seeds)
    assert not {0, 1, 5, 7, 11} & set(seeds)
    assert HELD_OUT not in TOWNS


def test_towns_are_simulated_once(tmp_path):
    write_poses(tmp_path / "03.txt", np.column_stack([np.zeros(60), np.zeros(60), np.arange(60)]))
    plans = (TownPlan(61, "03", 5, 8, "hdl32"),)
    counted = []
    folders = simulate_towns(tmp_path, tmp_path / "out", plans, counted.append)
    assert folders == [tmp_path / "out" / "sequences" / "61"]
    assert len(counted) == len(list((folders[0] / "velodyne").iterdir())) == 8
    about = json.loads((folders[0] / "simulation.json").read_text())
    assert (about["seed"], about["sensor"]) == (61, "hdl32")
    simulate_towns(tmp_path, tmp_path / "out", plans, counted.append)
    assert len(counted) == 8


def test_a_trajectory_that_is_missing_or_too_short_is_named(tmp_path):
    with pytest.raises(InputError, match=r"03\.txt"):
        simulate_towns(tmp_path, tmp_path / "out", (TownPlan(61, "03", 0, 8),))
    write_poses(tmp_path / "03.txt", np.column_stack([np.zeros(30), np.zeros(30), np.arange(30)]))
    with pytest.raises(InputError, match=r"03\.txt: 9 poses three metres apart after pose 5"):
        simulate_towns(tmp_path, tmp_path / "out", (TownPlan(61, "03", 5, 12),))

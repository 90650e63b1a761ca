"""Which pairs ``bench registration`` gives to whom, and what its table says of them."""

import csv
from dataclasses import replace

import numpy as np
import pytest

from sl3d_slam.bench import registration
from sl3d_slam.bench.drives import Drive
from sl3d_slam.bench.process import Ending
from sl3d_slam.bench.registration_methods import OURS
from sl3d_slam.bench.registration_plan import RegistrationBench, make_plan
from sl3d_slam.bench.registration_runner import to_pair
from sl3d_slam.geometry.se3 import distance_m


@pytest.fixture(scope="module")
def bench(ring_folder):
    """Six pairs 8 m apart, of which peers register four; and the ring against itself."""
    ring = Drive(str(ring_folder))
    return RegistrationBench(
        [ring], (8.0,), num_pairs=6, peer_pairs=4, different=[ring, ring], peers=("icp",)
    )


@pytest.fixture(scope="module")
def plan(bench):
    return make_plan(bench)


def test_pairs_of_different_places_join_the_drives_to_the_others_and_have_no_truth(bench, plan):
    apart, different = plan.groups
    assert [group.name for group in plan.groups] == ["8 m", "different places"]
    assert set(plan.places) == {0, 1, 2}
    assert all(pair.truth is not None for pair in apart.pairs)
    assert all(abs(distance_m(pair.T_target_source) - 8.0) <= 1.0 for pair in apart.pairs)
    assert all(pair.truth is None and pair.source_drive == 0 for pair in different.pairs)
    assert [pair.target_drive for pair in different.pairs] == [1, 2, 1, 2, 1, 2]
    turns = np.array([pair.T_turned_source for pair in different.pairs])
    assert np.ptp(turns[:, 0, 0]) > 0.1  # each source is turned by another yaw


def test_peers_register_the_first_pairs_of_each_group_and_ours_all(bench, plan):
    pairs = plan.groups[0].pairs
    assert list(bench.pairs_for(OURS, pairs)) == pairs
    assert list(bench.pairs_for(("icp",), pairs)) == pairs[:4]
    assert bench.num_steps(plan) == 6 + 6 + 4 + 4


def answer_truly(module, folder, task, progress):
    """A process whose every method knows the truth and calls pairs without any a success, too."""
    attempts = []
    for tree in task["pairs"]:
        pair = to_pair(tree)
        pose = np.eye(4) if pair.truth is None else pair.truth
        one = {"T_target_source": pose.tolist(), "extract_s": 0.1, "match_s": 0.2}
        attempts.append([{**one, "can_refuse": True} for _ in task["methods"]])
    return Ending("", 1.0, {"attempts": attempts})


def test_the_table_counts_each_methods_own_pairs(bench, plan, tmp_path, monkeypatch):
    monkeypatch.setattr(registration, "run_runner", answer_truly)
    registration.run(bench, plan, tmp_path)
    with (tmp_path / "registration.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(line for line in file if not line.startswith("#")))
    found = {(row["pairs_of"], row["method"]): row for row in rows}
    assert len(found) == len(rows) == 6
    for method, count in ((OURS[0], 6), (OURS[1], 6), ("icp", 4)):
        apart, different = found["8 m", method], found["different places", method]
        assert int(apart["num_pairs"]) == int(different["num_pairs"]) == count
        assert float(apart["recall_percent"]) == 100.0
        assert int(apart["wrong"]) == 0
        assert different["recall_percent"] in ("", "-")
        assert int(different["wrong"]) == count
    for name in ("registration.md", "registration.png", "registration_curves.png"):
        assert (tmp_path / name).stat().st_size > 0
    assert "first 4 pairs" in (tmp_path / "registration.md").read_text(encoding="utf-8")


def test_peers_that_are_not_installed_leave_their_rows_and_no_curve(
    bench, plan, tmp_path, monkeypatch
):
    def absent(module, folder, task, progress):
        ours = tuple(task["methods"]) == OURS
        return (
            answer_truly(module, folder, task, progress) if ours else Ending("not installed", 1.0)
        )

    monkeypatch.setattr(registration, "run_runner", absent)
    table = registration.run(replace(bench, iterations=(100,)), plan, tmp_path)
    status = {row["method"]: row["status"] for row in table.rows}
    assert status == {
        **dict.fromkeys(OURS, "ok"),
        **dict.fromkeys(("icp", "fpfh-ransac@100"), "not installed"),
    }
    assert not (tmp_path / "registration_ransac.png").exists()

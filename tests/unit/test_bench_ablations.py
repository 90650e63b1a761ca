"""The ablations: every variant is another network, trained alike and not twice."""

import numpy as np
import pytest

from sl3d_slam.bench.ablations import BASE, VARIANTS, Ablations, run
from sl3d_slam.errors import InputError
from sl3d_slam.lines.network.settings import NetworkSettings
from sl3d_slam.simulation.drive import plan_drive
from sl3d_slam.simulation.roads import Road
from sl3d_slam.simulation.town import build_town
from sl3d_slam.simulation.write import Layout, write_drive

TINY = {"width": 8, "num_neighbours": 6}


@pytest.fixture(scope="module")
def towns(tmp_path_factory):
    """Two small towns of eight scans, five metres apart on a bend."""
    root, folders = tmp_path_factory.mktemp("towns"), []
    way = 5.0 * np.arange(8)
    bend = np.column_stack([way, 0.004 * way**2, np.zeros(8), np.arctan(0.008 * way)])
    for seed in (61, 62):
        planned = plan_drive(build_town(Road("bend", bend), seed), "hdl32")
        folders.append(write_drive(planned, Layout(root, f"{seed}")))
    return folders


def test_the_papers_ablations_are_all_there():
    networks = [NetworkSettings.model_validate(BASE.model_dump() | v) for v in VARIANTS.values()]
    assert {network.stride for network in networks} == {1, 2, 4, 6}
    assert {network.descriptor_dim for network in networks} == {16, 32, 64, 128}
    assert {network.neighbours for network in networks} == {"space", "features"}
    for changes in VARIANTS.values():
        assert len(changes) <= 1  # one thing at a time


def test_variants_are_measured_and_not_trained_twice(towns, tmp_path):
    variants = {"plain": TINY, "among features": TINY | {"neighbours": "features"}}
    what = Ablations((towns[0],), towns[1], steps=2, points=300, variants=variants)
    steps = []
    table = run(what, tmp_path / "out", progress=lambda note, n: steps.append(n))
    assert sum(steps) == 4
    assert [row["variant"] for row in table.rows] == list(variants)
    for row in table.rows:
        assert 0.0 <= row["best_f1"] <= 1.0
        assert row["cost_ms"] > 0
    assert table.rows[0]["weights"] == table.rows[1]["weights"]
    again = run(what, tmp_path / "out")
    for first, second in zip(table.rows, again.rows, strict=True):
        assert first["best_f1"] == second["best_f1"]
        assert first["five_10m"] == second["five_10m"]
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert names == {"0", "1", "prepared", "ablations.csv", "ablations.md", "ablations_table.png"}


def test_a_drive_held_out_is_not_learned_from(towns, tmp_path):
    with pytest.raises(InputError, match="held out"):
        run(Ablations((towns[0], towns[1]), towns[1]), tmp_path / "out")

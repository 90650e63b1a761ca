"""bench backend: every method over every world, and the graph that grows."""

import csv

import numpy as np
import pytest

from sl3d_slam.bench import backend
from sl3d_slam.bench.backend import Extent
from sl3d_slam.bench.backend_methods import METHODS
from sl3d_slam.errors import InputError

SMALL = Extent((0.5,), num_true=20, stride=20, num_growing=1_000)


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    out, steps = tmp_path_factory.mktemp("backend"), []
    tables = backend.run(out, SMALL, progress=lambda note, count: steps.append(count))
    assert sum(steps) == backend.num_steps(SMALL)
    return tables, out


def test_ours_is_the_oracle_where_false_loops_ruin_plain_least_squares(measured):
    rows = {(row["kind"], row["method"]): row for row in measured[0][0].rows}
    assert len(rows) == 2 * len(METHODS)
    for kind in ("random", "aliased"):
        assert rows[kind, "ours"]["by_oracle"] < 1.05
        assert rows[kind, "ours, live"]["by_oracle"] < 1.05
        assert rows[kind, "ours"]["kept_false"] == "0/20"
        assert rows[kind, "LM"]["by_oracle"] > 5.0
        assert 0.0 < rows[kind, "ours, live"]["update_median_ms"] < 20.0


def test_everything_is_left_in_the_folder(measured):
    tables, out = measured
    with (out / "backend.csv").open(encoding="utf-8") as file:
        assert len(list(csv.DictReader(file))) == len(tables[0].rows)
    with (out / "backend_2.csv").open(encoding="utf-8") as file:
        assert [int(row["num_keyframes"]) for row in csv.DictReader(file)][-1] == 1_000
    for picture in ("backend.png", "backend_growth.png", "backend_table.png"):
        assert (out / picture).read_bytes().startswith(b"\x89PNG")
    text = (out / "backend.md").read_text(encoding="utf-8")
    assert "228 poses of the built-in drive" in text
    assert "ours, live" in text


def test_growth_tells_of_every_tenth_of_the_way(measured):
    rows = measured[0][1].rows
    assert [row["num_keyframes"] for row in rows] == list(np.arange(100, 1_001, 100))
    for row in rows:
        assert 0.0 < row["median_ms"] <= row["p90_ms"] <= row["p99_ms"] <= row["max_ms"]


def test_a_trajectory_that_is_none_is_named(tmp_path):
    with pytest.raises(InputError, match=r"nothing\.txt"):
        backend.run(tmp_path / "out", SMALL, tmp_path / "nothing.txt")

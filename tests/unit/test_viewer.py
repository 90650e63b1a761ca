"""``sl3d view``: a recording of a map or a run, and what it says where rerun is missing."""

import sys

import numpy as np
import pytest

from sl3d_slam.errors import MissingExtraError, OutputError
from sl3d_slam.report.viewer import Scene, Street, show
from sl3d_slam.types import LineSet


@pytest.fixture
def scene(rng):
    lines = LineSet(rng.normal(size=(5, 2, 3)), np.zeros((5, 0), np.float32), np.full(5, 3))
    keyframes = rng.normal(size=(4, 3))
    cloud = rng.normal(size=(50, 3)).astype(np.float32)
    return Scene(lines, np.arange(1, 6), keyframes, cloud, simulated=True)


@pytest.fixture
def street(rng):
    way = rng.normal(size=(10, 3))
    return Street(way, way + 0.1, [(9, 0, "accepted"), (8, 1, "rejected")])


def test_without_rerun_it_says_what_to_install(scene, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(MissingExtraError, match=r"sl3d-slam\[view\]"):
        show(scene, None, tmp_path / "a.rrd")


def test_a_recording_is_written(scene, street, tmp_path):
    pytest.importorskip("rerun", reason="the view extra is not installed")
    out = tmp_path / "a.rrd"
    show(scene, street, out)
    assert out.read_bytes().startswith(b"RRF2")
    assert out.stat().st_size > 1000


def test_a_folder_that_is_not_there_is_named(scene, tmp_path):
    pytest.importorskip("rerun", reason="the view extra is not installed")
    with pytest.raises(OutputError, match="nowhere"):
        show(scene, None, tmp_path / "nowhere" / "a.rrd")

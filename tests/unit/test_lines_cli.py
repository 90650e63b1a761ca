"""``sl3d lines`` on a scan of two poles: what it writes, and what it says when it cannot."""

import json

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from sl3d_slam.cli.errors import Verbs
from sl3d_slam.cli.lines import lines

POLES = np.array([[8.0, 3.0], [-6.0, 5.0]])


@pytest.fixture(scope="module")
def scan(tmp_path_factory):
    """A folder scan: flat ground 1.7 m below the sensor and two columns of returns."""
    rng = np.random.default_rng(4)
    ground = np.c_[rng.uniform(-15, 15, (6000, 2)), np.full(6000, -1.7)]
    columns = [
        np.c_[np.tile(xy, (200, 1)) + rng.normal(0, 0.01, (200, 2)), rng.uniform(-1.7, 2.0, 200)]
        for xy in POLES
    ]
    points = np.concatenate([ground, *columns])
    path = tmp_path_factory.mktemp("scan") / "000000.bin"
    np.c_[points, np.zeros(len(points))].astype("<f4").tofile(path)
    return path


@pytest.fixture(scope="module")
def sl3d():
    app = typer.Typer(cls=Verbs)
    app.command()(lines)
    app.command("other")(lambda: None)
    return lambda *words: CliRunner().invoke(app, ["lines", *map(str, words)])


def test_json_on_stdout_and_in_a_file_agree(sl3d, scan, tmp_path):
    out = tmp_path / "lines.json"
    result = sl3d(scan, "--json", "--out", out)
    assert result.exit_code == 0
    found = json.loads(result.stdout)
    assert found == json.loads(out.read_text())
    assert [line["kind"] for line in found] == ["pole", "pole"]
    places = np.array([line["endpoints_lidar"] for line in found]).mean(axis=1)[:, :2]
    distance = np.linalg.norm(places[:, None] - POLES[None], axis=2).min(axis=1)
    assert distance.max() < 0.05  # 200 returns of 1 cm, seen from all sides


def test_ply_has_two_vertices_and_an_edge_a_line(sl3d, scan, tmp_path):
    out = tmp_path / "lines.ply"
    assert sl3d(scan, "--out", out).exit_code == 0
    header, body = out.read_text().split("end_header\n")
    rows = body.splitlines()
    assert "element vertex 4" in header
    assert "element edge 2" in header
    vertices = np.array([row.split()[:3] for row in rows[:4]], float)
    assert np.ptp(vertices[:2, 2]) > 3.0
    assert [row.split()[:2] for row in rows[4:]] == [["0", "1"], ["2", "3"]]


def test_png_is_a_picture(sl3d, scan, tmp_path):
    out = tmp_path / "lines.png"
    result = sl3d(scan, "--out", out)
    assert result.exit_code == 0
    assert out.read_bytes().startswith(b"\x89PNG")
    assert "2 lines (2 pole)" in result.stdout


def test_settings_from_the_command_line_are_used(sl3d, scan):
    result = sl3d(scan, "--json", "--set", "lines.min_length_m=10")
    assert json.loads(result.stdout) == []


@pytest.mark.parametrize("name", ["lines.txt", "lines"])
def test_unknown_suffix_is_refused_before_any_work(sl3d, scan, tmp_path, name):
    result = sl3d(scan, "--out", tmp_path / name)
    assert result.exit_code == 2
    assert name in result.stderr
    assert list(tmp_path.iterdir()) == []


def test_missing_and_damaged_scans_are_named(sl3d, tmp_path):
    damaged = tmp_path / "cut.bin"
    damaged.write_bytes(b"\0" * 1001)
    for path in (tmp_path / "none.bin", damaged):
        result = sl3d(path)
        assert result.exit_code == 2
        assert path.name in result.stderr
        assert len(result.stderr.strip().splitlines()) == 1

"""``sl3d map`` with other people's measurements: what they leave, and what is refused."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from sl3d_slam import LineMap
from sl3d_slam.cli.main import app
from sl3d_slam.geometry.se3 import exp, transform_points
from sl3d_slam.io.trajectory import read_tum

NUM_SCANS = 16  # 30 m: a street and its corner
METRES_A_DEGREE = 111_207.0, 73_170.0  # of latitude, of longitude at 49 degrees
T_ENU_MAP = exp(np.array([0.0, 0.0, 2.2, 300.0, -120.0, 4.0]))
LEVER = np.array([1.5, -1.0, 0.5])


def run(*arguments):
    """Run the command line in this process."""
    return CliRunner().invoke(app, ["map", *map(str, arguments), "--quiet"])


def assert_refused(result, *words):
    assert result.exit_code == 2, (result.output, result.exception)
    lines = result.stderr.strip().splitlines()
    assert len(lines) == 1, result.stderr
    assert lines[0].startswith("sl3d: ")
    for word in words:
        assert str(word) in lines[0]


@pytest.fixture(scope="module")
def stamps_s(ring_folder):
    return np.loadtxt(ring_folder / "sequences" / "00" / "times.txt")[:NUM_SCANS]


@pytest.fixture(scope="module")
def placed(ring_folder, ring_dataset, stamps_s, tmp_path_factory):
    """The run that a drive with GPS (5 cm, a lever arm) and gravity leaves."""
    folder = tmp_path_factory.mktemp("world")
    antennas = [transform_points(pose, LEVER[None])[0] for pose in ring_dataset.truth[:NUM_SCANS]]
    east, north, up = transform_points(T_ENU_MAP, np.array(antennas)).T
    rows = np.column_stack(
        [stamps_s, 49.0 + north / METRES_A_DEGREE[0], 8.4 + east / METRES_A_DEGREE[1], 115 + up]
    )
    np.savetxt(
        folder / "gps.csv", np.c_[rows, np.full(NUM_SCANS, 0.05)], "%.12g", ",",
        header="t,lat,lon,alt,sigma", comments="",
    )  # fmt: skip
    ups = ring_dataset.truth[:NUM_SCANS, 2, :3]
    np.savetxt(
        folder / "imu.csv", np.c_[stamps_s, ups], "%.9f", ",",
        header="t,up_x,up_y,up_z", comments="",
    )  # fmt: skip
    lever = [f"--set=world.antenna_{axis}_m={x}" for axis, x in zip("xyz", LEVER, strict=True)]
    files = ("--gps", folder / "gps.csv", "--attitude", folder / "imu.csv", "--covariance")
    out = folder / "run"
    result = run(ring_folder, "--out", out, "--scans", NUM_SCANS, *files, *lever)
    assert result.exit_code == 0, result.stderr
    return out


def test_the_map_says_where_on_the_earth_it_lies(placed, ring_dataset):
    georeference = LineMap.load(placed / "map.sl3d").origin.georeference
    origin = georeference.origin
    scans = read_tum(placed / "poses_tum.txt").T_world_lidar
    # the file's zero is its first fix, wherever that antenna was
    zero = transform_points(T_ENU_MAP @ ring_dataset.truth[0], LEVER[None])[0]
    expected = (T_ENU_MAP @ ring_dataset.truth[:NUM_SCANS])[:, :3, 3] - zero
    found = (georeference.T_enu_map @ scans)[:, :3, 3]
    # 16 fixes of 5 cm with a lever arm, and degrees turned into metres by hand to 1e-4
    assert np.linalg.norm(found - expected, axis=1).max() < 0.15
    assert origin.latitude_deg == pytest.approx(49.0 + zero[1] / METRES_A_DEGREE[0], abs=1e-9)
    told = json.loads((placed / "run.json").read_text())
    assert told["world"]["fixes_given"] == 2 * NUM_SCANS
    assert told["world"]["fixes_used"] >= 2 * NUM_SCANS - 2
    np.testing.assert_allclose(told["georeference"]["T_enu_map"], georeference.T_enu_map)


def test_every_keyframe_has_a_covariance(placed, stamps_s):
    table = np.loadtxt(placed / "covariance.txt")
    figures = json.loads((placed / "metrics.json").read_text())
    assert len(table) == figures["num_keyframes"] > 2
    np.testing.assert_allclose(table[:, 0], stamps_s[table[:, 1].astype(int)])
    matrices = table[:, 2:].reshape(-1, 6, 6)
    np.testing.assert_allclose(matrices, np.swapaxes(matrices, 1, 2), rtol=1e-6, atol=1e-12)
    sigmas_m = np.sqrt(np.linalg.eigvalsh(matrices[:, 3:, 3:]))
    assert sigmas_m.min() > 0.0
    assert sigmas_m.max() < 0.2  # GPS of 5 cm, four times and more


@pytest.mark.parametrize(
    ("option", "text", "word"),
    [
        ("--gps", "", "empty"),
        ("--gps", "\x00\xff\x00", "fixes.csv"),
        ("--gps", "t,lat,lon\n0,49,8\n", "no column 'alt'"),
        ("--gps", "t,lat,lon,alt\n0,49,8.4,nan\n", "line 2"),
        ("--gps", "t,lat,lon,alt\n0,190,8.4,1\n", "degrees"),
        ("--gps", "1 2 3\n", "8 finite numbers"),
        ("--attitude", "t,up_x,up_y,up_z\n0,0,0,0\n", "no length"),
        ("--attitude", "t,qx,qy,qz,qw\n0,0,0,0,2\n", "unit length"),
    ],
)
def test_a_malformed_file_is_refused_before_the_work(ring_folder, tmp_path, option, text, word):
    damaged = tmp_path / "fixes.csv"
    damaged.write_bytes(text.encode("latin-1"))
    out = tmp_path / "run"
    assert_refused(run(ring_folder, "--out", out, option, damaged), damaged, word)
    assert not out.exists()


@pytest.mark.parametrize("option", ["--gps", "--attitude"])
def test_a_file_that_is_not_there(ring_folder, tmp_path, option):
    missing = tmp_path / "none.csv"
    assert_refused(run(ring_folder, "--out", tmp_path / "run", option, missing), missing)
    assert_refused(run(ring_folder, "--out", tmp_path / "run", option, tmp_path), tmp_path)


def test_fixes_of_another_clock_are_said_to_be(ring_folder, tmp_path):
    (tmp_path / "gps.csv").write_text("t,lat,lon,alt\n1e9,49,8.4,1\n1000000001,49,8.4,1\n")
    arguments = ("--out", tmp_path / "run", "--scans", 3, "--gps", tmp_path / "gps.csv")
    assert_refused(run(ring_folder, *arguments), "expected one clock")

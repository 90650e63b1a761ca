"""Wrong input, wrong settings, nowhere to write: status 2, one sentence, nothing left behind."""

import shutil

import numpy as np
import pytest
from typer.testing import CliRunner

from sl3d_slam.cli.main import app

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")  # numpy would print a second line


@pytest.fixture
def scan(rng):
    """Level ground with a few poles: a scan like any other."""
    ground = np.c_[rng.uniform(-30, 30, (4000, 2)), np.full(4000, -1.7)]
    poles = [
        np.c_[xy + rng.normal(0, 0.01, (150, 2)), rng.uniform(-1.7, 3.0, 150)]
        for xy in rng.uniform(-20, 20, (6, 2))
    ]
    return np.concatenate([ground, *poles])


def write_bin(path, points):
    np.c_[points, np.zeros(len(points))].astype("<f4").tofile(path)
    return path


@pytest.fixture
def kitti(tmp_path, scan):
    """A KITTI root with one sequence of three scans, whole."""
    folder = tmp_path / "kitti" / "sequences" / "07"
    (folder / "velodyne").mkdir(parents=True)
    for index in range(3):
        write_bin(folder / "velodyne" / f"{index:06d}.bin", scan)
    (folder / "calib.txt").write_text("Tr: 0 -1 0 0 0 0 -1 0 1 0 0 0\n")
    (folder / "times.txt").write_text("0.0\n0.1\n0.2\n")
    return tmp_path / "kitti"


def run(*arguments):
    """Run the command line in this process."""
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def assert_refused(result, *words):
    assert result.exit_code == 2, (result.output, result.exception)
    lines = result.stderr.strip().splitlines()
    assert len(lines) == 1, result.stderr
    assert lines[0].startswith("sl3d: ")
    assert "Traceback" not in result.output
    for word in words:
        assert str(word) in lines[0]


def assert_nothing_written(out):
    assert not out.exists() or list(out.iterdir()) == []


@pytest.fixture
def out(tmp_path):
    return tmp_path / "run"


def test_the_whole_sequence_is_mapped(kitti, out):
    """So that what fails below fails for its damage."""
    assert run("map", kitti, "--out", out, "--quiet").exit_code == 0
    assert (out / "map.sl3d").is_file()


def test_no_such_folder(out, tmp_path):
    assert_refused(run("map", tmp_path / "nowhere", "--out", out), tmp_path / "nowhere")
    assert not out.exists()


def test_an_empty_folder(out, tmp_path):
    (tmp_path / "empty").mkdir()
    assert_refused(run("map", tmp_path / "empty", "--out", out), tmp_path / "empty")
    assert not out.exists()


@pytest.mark.parametrize(
    ("content", "word"),
    [
        (b"", "empty"),
        (b"\0" * 1001, "1001 bytes"),
        (np.full((500, 4), np.nan, "<f4").tobytes(), "0 of 500 points"),
        (np.zeros((500, 4), "<f4").tobytes(), "0 of 500 points"),
        (np.full((50, 4), 5.0, "<f4").tobytes(), "50 of 50 points"),
        (np.full((500, 4), np.inf, "<f4").tobytes(), "0 of 500 points"),
    ],
)
@pytest.mark.parametrize("place", [0, 2])
def test_a_damaged_scan_stops_the_run_and_leaves_no_half_of_one(kitti, out, content, word, place):
    damaged = kitti / "sequences" / "07" / "velodyne" / f"{place:06d}.bin"
    damaged.write_bytes(content)
    assert_refused(run("map", kitti, "--out", out, "--quiet"), damaged, word)
    assert_nothing_written(out)


@pytest.mark.parametrize("content", [b"", b"\0" * 1001, np.full((50, 4), 5, "<f4").tobytes()])
def test_a_damaged_single_scan_is_named_by_every_verb(ring_run, tmp_path, scan, content):
    damaged = tmp_path / "cut.bin"
    damaged.write_bytes(content)
    whole = write_bin(tmp_path / "whole.bin", scan)
    for arguments in (
        ("relocalize", ring_run / "map.sl3d", damaged),
        ("relocalize", ring_run / "map.sl3d", tmp_path / "none.bin", damaged),
        ("register", damaged, whole),
        ("register", whole, damaged),
    ):
        result = run(*arguments)
        assert_refused(result, "none.bin" if "none.bin" in str(arguments) else damaged)
        assert result.stdout == ""


def test_a_sequence_that_is_not_there_and_those_that_are(kitti, out):
    assert_refused(run("map", kitti, "--sequence", "08", "--out", out), kitti, "07")
    assert not out.exists()


def test_a_missing_calibration(kitti, out):
    calib = kitti / "sequences" / "07" / "calib.txt"
    calib.unlink()
    assert_refused(run("map", kitti, "--out", out), calib)
    assert not out.exists()


def test_a_folder_in_the_place_of_a_file_is_called_one(kitti, out, tmp_path):
    (tmp_path / "folder.bin").mkdir()
    assert_refused(run("lines", tmp_path / "folder.bin"), "folder.bin: is a folder; expected")
    result = run("map", kitti, "--out", out, "--attitude", tmp_path / "folder.bin")
    assert_refused(result, "folder.bin: is a folder; expected")


def test_a_wrong_kind_of_dataset(kitti, out):
    assert_refused(run("map", kitti, "--dataset", "nuscenes", "--out", out), "nuscenes")


@pytest.mark.parametrize(
    ("text", "key"),
    [("loops:\n  min_vote: 3\n", "loops.min_vote"), ("lines: 3\n", "lines"), ("a: [", "")],
)
def test_settings_that_are_none_name_file_and_key(kitti, out, tmp_path, text, key):
    config = tmp_path / "my.yaml"
    config.write_text(text)
    assert_refused(run("map", kitti, "--out", out, "--config", config), config, key)
    assert not out.exists()


def test_an_override_that_is_none(kitti, out):
    result = run("map", kitti, "--out", out, "--set", "loops.min_votes=many")
    assert_refused(result, "loops.min_votes")


def test_nowhere_to_write_is_found_out_before_the_work(kitti, tmp_path):
    taken = tmp_path / "taken"
    taken.write_text("a file, and precious")
    assert_refused(run("map", kitti, "--out", taken), taken)
    assert taken.read_text() == "a file, and precious"
    assert_refused(run("map", kitti, "--out", taken / "below"), taken / "below")
    assert_refused(run("map", kitti, "--out", "/proc/nothing/here"), "/proc/nothing/here")


def test_a_file_in_the_place_of_the_folder_of_a_training_is_found_out_first(kitti, tmp_path):
    taken = tmp_path / "taken"
    taken.write_text("a file, and precious")
    assert_refused(run("train", "synthetic", "--out", taken), taken, "expected a folder")
    assert_refused(run("train", "label", kitti, "--out", taken), taken, "expected a folder")


def test_no_scans_at_all_is_wrong_usage(kitti, out):
    assert run("map", kitti, "--out", out, "--scans", "0").exit_code == 2
    assert not out.exists()


def test_a_map_that_is_none(tmp_path, scan, ring_run):
    query = write_bin(tmp_path / "query.bin", scan)
    whole = (ring_run / "map.sl3d").read_bytes()
    foreign = tmp_path / "foreign.sl3d"
    for content in (b"", b"PNG, say", b"\xff" * 4000, whole[:100], whole[: len(whole) // 2]):
        foreign.write_bytes(content)
        assert_refused(run("relocalize", foreign, query), foreign)
    assert_refused(run("relocalize", tmp_path / "none.sl3d", query), "none.sl3d")
    assert_refused(run("relocalize", tmp_path, query), tmp_path)


def test_a_map_without_its_cloud_is_named_and_the_cure_with_it(kitti, out, tmp_path, scan):
    assert run("map", kitti, "--out", out, "--quiet", "--set", "map.clouds=false").exit_code == 0
    query = write_bin(tmp_path / "query.bin", scan)
    assert_refused(run("relocalize", out / "map.sl3d", query), out / "map.sl3d", "map.clouds")


@pytest.mark.parametrize(
    "words",
    [
        ("loops", "none", "--out", "nowhere/o.json"),
        ("register", "none", "none", "--out", "nowhere/o.png"),
        ("lines", "none", "--out", "nowhere/o.ply"),
        ("merge", "none", "none", "--out", "nowhere/o.sl3d"),
        ("export", "none", "nowhere/o.las"),
        ("view", "none", "--out", "nowhere/o.rrd"),
        ("train", "calibrate", "none", "none", "--out", "nowhere/o.safetensors"),
    ],
)
def test_a_file_that_cannot_be_written_is_found_out_before_anything_is_read(words):
    assert_refused(run(*words), words[-1], "its folder does not exist")


def test_an_earlier_run_survives_a_later_one_that_fails(kitti, out):
    assert run("map", kitti, "--out", out, "--quiet").exit_code == 0
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    shutil.rmtree(kitti / "sequences" / "07" / "velodyne")
    assert run("map", kitti, "--out", out, "--quiet").exit_code == 2
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before

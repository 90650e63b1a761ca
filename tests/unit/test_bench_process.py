"""Benchmarks run systems in processes of their own; a missing or dying one is named."""

import json
import re
import subprocess
import sys

import numpy as np
import pytest

from sl3d_slam.bench import growth, peers
from sl3d_slam.bench.drives import Comparison, Drive
from sl3d_slam.bench.peers import INSTALL, explain_absence, importing
from sl3d_slam.bench.process import ANSWER, ending, serve
from sl3d_slam.bench.registration_plan import RegistrationBench, make_plan
from sl3d_slam.bench.slam import run
from sl3d_slam.bench.systems import make_system
from sl3d_slam.config import SlamConfig
from sl3d_slam.errors import InputError, MissingExtraError
from sl3d_slam.geometry.se3 import from_yaw, invert
from sl3d_slam.report.metrics import ate_rmse_m


@pytest.fixture
def drive(tmp_path, rng):
    """A KITTI sequence of 14 scans through a box of points, with its poses."""
    folder = tmp_path / "data" / "sequences" / "07"
    (folder / "velodyne").mkdir(parents=True)
    poses = np.stack([from_yaw(0.01 * k, np.array([1.2 * k, 0.0, 0.0])) for k in range(14)])
    world = np.concatenate(
        [rng.uniform([-30, y, -2], [60, y + 0.1, 6], (4000, 3)) for y in (-9, 9)]
    )
    world = np.concatenate([world, rng.uniform([-30, -9, -2], [60, 9, -1.95], (4000, 3))])
    world = np.concatenate([world, rng.uniform([45, -9, -2], [45.1, 9, 6], (2000, 3))])
    for k, pose in enumerate(poses):
        seen = (world - pose[:3, 3]) @ pose[:3, :3]
        rows = np.column_stack([seen, np.zeros(len(seen))]).astype("<f4")
        rows.tofile(folder / "velodyne" / f"{k:06d}.bin")
    T_cam_lidar = np.array([[0, -1.0, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
    numbers = " ".join(str(value) for value in T_cam_lidar[:3].ravel())
    (folder / "calib.txt").write_text(f"Tr: {numbers}\n")
    (folder / "simulation.json").write_text("{}")
    (tmp_path / "data" / "poses").mkdir()
    camera = T_cam_lidar @ poses @ invert(T_cam_lidar)
    np.savetxt(tmp_path / "data" / "poses" / "07.txt", camera[:, :3].reshape(-1, 12))
    return Drive(str(tmp_path / "data"))


def test_a_peer_that_is_absent_is_named_with_how_to_install_it():
    with (
        pytest.raises(MissingExtraError, match=r"no_such_peer.*not installed") as caught,
        importing("kiss-slam"),
    ):
        import no_such_peer  # noqa: F401
    assert INSTALL in str(caught.value)
    assert str(caught.value).startswith("kiss-slam")


@pytest.mark.parametrize(
    ("library", "package"),
    [("libusb-1.0.so.0", "libusb-1.0-0"), ("libGL.so.1", "libgl1"), ("libgomp.so.1", "libgomp1")],
)
def test_a_missing_system_library_is_named_with_its_debian_package(library, package):
    text = f"{library}: cannot open shared object file: No such file or directory"
    for error in (OSError(text), ImportError(text)):
        sentence = explain_absence("kiss-slam", error)
        assert library in sentence
        assert f"apt-get install {package}" in sentence
        assert INSTALL in sentence


def test_installed_and_absent_peers_are_listed(monkeypatch):
    monkeypatch.setattr(peers, "DISTRIBUTIONS", ("numpy", "no-such-peer"))
    assert peers.installed_peers() == f"numpy {np.__version__}, no-such-peer not installed"


@pytest.mark.parametrize(
    ("status", "log", "words"),
    [
        (-11, "one\ntwo\n", "killed by signal 11.*two"),
        (1, "Traceback\nValueError: odd\n", "status 1.*ValueError: odd"),
        (1, "pydantic.ValidationError: odd\n  a key\n    For more see x\n", "Error: odd"),
        (0, "", "status 0.*nothing"),
    ],
)
def test_a_process_that_dies_is_named_with_its_last_words(tmp_path, status, log, words):
    assert re.search(words, ending(tmp_path, status, log, 1.0).problem)


def test_an_error_of_ours_becomes_the_answer_of_a_process(tmp_path):
    (tmp_path / "task.json").write_text("{}")

    def work(task, folder, step):
        step()
        raise InputError("road.bin: is empty")

    serve(tmp_path, work)
    assert json.loads((tmp_path / ANSWER).read_text()) == {"error": "road.bin: is empty"}
    assert (tmp_path / "progress").read_bytes() == b"."
    assert ending(tmp_path, 0, "", 1.0).problem == "road.bin: is empty"


def test_a_missing_peer_has_a_row_and_the_others_still_run(drive, tmp_path, monkeypatch):
    """The peer is hidden from the child process by a module of its name that fails to import."""
    hide = tmp_path / "hide" / "kiss_slam"
    hide.mkdir(parents=True)
    (hide / "__init__.py").write_text(
        "raise ModuleNotFoundError(\"No module named 'kiss_slam'\", name='kiss_slam')"
    )
    monkeypatch.setenv("PYTHONPATH", str(hide.parent))
    told = []
    bench = Comparison([drive], ("kiss-slam",))
    table = run(bench, tmp_path / "out", progress=lambda system, n: told.append((system, n)))
    ours, missing = table.rows
    assert ours["status"] == "ok"
    assert ours["kind"] == "simulated"
    assert "kiss_slam is not installed" in missing["status"]
    assert INSTALL in missing["status"]
    assert INSTALL in (tmp_path / "out" / "slam.md").read_text()
    assert ours["ate_m"] < 0.1  # a box without noise, centimetres expected of ICP
    assert ours["scans"] == 14
    assert ours["map_mb"] > 0.0
    assert ours["peak_rss_mb"] >= ours["rss_last_mb"] > 20.0
    assert sum(n for system, n in told if system == "sl3d-slam") == 14
    written = {path.name for path in (tmp_path / "out").iterdir()}
    assert {"slam.csv", "slam.md", "slam.png", "slam_0_07_paths.png"} <= written


def test_growth_maps_every_length_and_refuses_more_scans_than_there_are(drive, tmp_path):
    table = growth.run(growth.GrowthBench(drive, (10, 6)), tmp_path / "out")
    assert [row["scans"] for row in table.rows] == [6, 10]
    assert all(row["status"] == "ok" and row["peak_rss_mb"] > 20.0 for row in table.rows)
    written = {path.name for path in (tmp_path / "out").iterdir()}
    assert {"growth.csv", "growth.md", "growth.png"} <= written
    with pytest.raises(InputError, match="14 scans"):
        growth.run(growth.GrowthBench(drive, (6, 15)), tmp_path / "none")
    assert not (tmp_path / "none").exists()


def test_kiss_icp_gives_a_pose_a_scan_and_no_loops(drive):
    system = make_system("kiss-icp", SlamConfig())
    opened = drive.open(SlamConfig().input)
    for scan in drive.stream(opened):
        system.process(scan)
    outcome = system.finish()()
    assert outcome.map_bytes is None
    assert outcome.loops == []
    # KISS-ICP knows no velocity at first: at worst it stands still for one step of 1.2 m, which
    # one scan of 14 turns into 1.2 m * sqrt(13) / 14 = 0.31 m.
    assert ate_rmse_m(outcome.T_world_lidar, opened.truth) < 0.4


def test_unknown_peers_are_refused_before_anything_runs(drive, tmp_path):
    with pytest.raises(InputError, match="orb-slam"):
        run(Comparison([drive], ("orb-slam",)), tmp_path / "out")
    assert not (tmp_path / "out").exists()
    with pytest.raises(InputError, match="teaser"):
        make_plan(RegistrationBench([drive], peers=("teaser",)))


def test_a_plan_holds_true_poses_and_is_the_same_for_the_same_seed(drive):
    bench = RegistrationBench([drive], distances_m=(5.0, 10.0), num_pairs=8, seed=3)
    plan, again = make_plan(bench), make_plan(bench)
    assert plan.simulated
    assert [group.name for group in plan.groups] == ["5 m", "10 m"]
    for group, same, distance_m in zip(plan.groups, again.groups, (5.0, 10.0), strict=True):
        for pair, twin in zip(group.pairs, same.pairs, strict=True):
            assert np.linalg.norm(pair.T_target_source[:3, 3]) == pytest.approx(
                distance_m, abs=1.0001
            )
            # Along x: the source is ahead of the target where its index is higher.
            ahead = pair.T_target_source[0, 3]
            assert np.sign(ahead) == np.sign(pair.source - pair.target)
            np.testing.assert_array_equal(pair.truth, twin.truth)


def test_distances_that_no_pair_has_are_named(drive):
    with pytest.raises(InputError, match="500"):
        make_plan(RegistrationBench([drive], distances_m=(500.0,)))
    with pytest.raises(InputError, match="odometry"):
        make_plan(RegistrationBench([drive], truth="gps"))


def test_heavy_libraries_are_not_loaded_by_the_command(repository):
    code = "import sl3d_slam.cli.main, sys; print('sl3d_slam.bench.slam' in sys.modules)"
    answer = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert answer.stdout.strip() == "False"

"""What many tests share: a seeded generator, the repository's root, real scans where present."""

import lzma
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest


@pytest.fixture
def rng():
    return np.random.default_rng(20240607)


@pytest.fixture(scope="session")
def repository():
    """The checkout that holds configs/ and examples/; the package itself may be installed apart."""
    return Path(__file__).resolve().parent.parent


@pytest.fixture(scope="session")
def shared(repository):
    """The folder of real scans and true trajectories beside the checkout, which few people have."""
    folder = repository.parent / "shared"
    if not (folder / "data" / "README.md").is_file():
        pytest.skip("needs the real scans of ../shared, which are not here")
    return folder


@pytest.fixture(scope="session")
def real_scans(shared):
    """A reader of single scans of a real drive: ``real_scans("01", [0, 10])`` -> [(N, 3), ...]."""

    def read(sequence, wanted):
        found = {}
        with lzma.open(shared / "data" / f"{sequence}.xz") as file:
            count = int(np.frombuffer(file.read(4), "<u4")[0])
            sizes = np.frombuffer(file.read(4 * count), "<u4")
            for index, size in enumerate(sizes[: max(wanted) + 1].tolist()):
                raw = file.read(10 * size)
                if index in wanted:
                    found[index] = _decoded(raw)
        return [found[index] for index in wanted]

    return read


def _decoded(raw):
    """Undo ../shared/data/unpack.py's packing: zigzag differences in mm, byte by byte."""
    planes = np.frombuffer(raw, np.uint8).reshape(10, -1).astype(np.int64)
    zigzag = np.stack(
        [planes[3 * k] | planes[3 * k + 1] << 8 | planes[3 * k + 2] << 16 for k in range(3)], axis=1
    )
    return np.cumsum((zigzag >> 1) ^ -(zigzag & 1), axis=0) / 1000.0


@pytest.fixture(scope="session")
def ring_drive():
    """A plan of 59 scans, 2 m apart, once and a third round a small block of houses."""
    # imported here: modules imported by a conftest escape the run-time type checks
    from sl3d_slam.simulation.drive import plan_drive
    from sl3d_slam.simulation.roads import Road, _closed, _drive
    from sl3d_slam.simulation.town import build_town

    corners = [(0, 0), (30, 0), (30, 20), (0, 20)]
    road = Road("ring", _drive(_closed(corners, 8.0, 36.0), 2.0))
    return plan_drive(build_town(road, seed=3), "hdl32")


@pytest.fixture(scope="session")
def ring_folder(ring_drive, tmp_path_factory):
    """The drive as a KITTI root with sequence 00 and true poses."""
    from sl3d_slam.simulation.write import Layout, write_drive

    root = tmp_path_factory.mktemp("ring")
    write_drive(ring_drive, Layout(root, truth=False))
    return root


@pytest.fixture(scope="session")
def ring_dataset(ring_folder):
    from sl3d_slam.config import InputSettings
    from sl3d_slam.io.open import open_dataset

    return open_dataset(ring_folder, InputSettings())


@pytest.fixture(scope="session")
def sl3d():
    """The command line in its own process, as a user runs it: ``sl3d("map", folder, ...)``."""

    def run(*arguments):
        command = [sys.executable, "-c", "from sl3d_slam.cli.main import main; main()"]
        command += [str(argument) for argument in arguments]
        return subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)

    return run


@pytest.fixture(scope="session")
def ring_run(sl3d, ring_folder, tmp_path_factory):
    """The folder that ``sl3d map`` leaves of the simulated drive."""
    out = tmp_path_factory.mktemp("runs") / "ring"
    result = sl3d("map", ring_folder, "--out", out, "--quiet")
    assert result.returncode == 0, result.stderr
    return out

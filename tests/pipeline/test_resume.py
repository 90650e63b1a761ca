"""A run that was killed goes on where it was and ends with the files of one that was not."""

import pytest

from sl3d_slam import SlamPipeline, load_config
from sl3d_slam.cli.map import identity_of
from sl3d_slam.errors import InputError
from sl3d_slam.journal import FILE, FOLDER, open_journal

EXACT = ("poses_tum.txt", "poses_kitti.txt", "odometry_tum.txt", "loops.json", "graph.g2o")


@pytest.fixture(scope="module")
def killed(ring_dataset, tmp_path_factory):
    """The folder of a run that ended after 50 of 59 scans, loops found, in the middle of a write.

    Records reach the system one by one, so leaving the pipeline alone is as good as a kill.
    """
    folder = tmp_path_factory.mktemp("killed")
    journal = open_journal(folder, identity_of(ring_dataset, load_config()), resume=False)
    slam = SlamPipeline(load_config(), simulated=True, journal=journal)
    for scan in ring_dataset.iterate(0, 50):
        slam.process(scan)
    assert slam.num_loops > 0
    journal.close()
    path = folder / FOLDER / FILE
    path.write_bytes(path.read_bytes()[:-41])
    return folder


def test_an_interrupted_run_is_neither_lost_nor_taken_for_another(killed, ring_dataset):
    identity = identity_of(ring_dataset, load_config())
    with pytest.raises(InputError, match="holds an interrupted run; --resume continues it"):
        open_journal(killed, identity, resume=False)
    coarse = identity_of(ring_dataset, load_config(None, ["odometry.voxel_size_m=0.8"]))
    with pytest.raises(InputError, match="had another config"):
        open_journal(killed, coarse, resume=True)
    with pytest.raises(InputError, match="had another input"):
        open_journal(killed, identity | {"input": "KITTI sequence elsewhere"}, resume=True)
    with pytest.raises(InputError, match="had another version"):
        open_journal(killed, identity | {"version of sl3d_slam": "0.0"}, resume=True)


def test_scans_that_changed_meanwhile_are_refused(killed, ring_dataset):
    journal = open_journal(killed, identity_of(ring_dataset, load_config()), resume=True)
    slam = SlamPipeline(load_config(), journal=journal)
    slam.process(next(ring_dataset.iterate(0, 1)))
    with pytest.raises(InputError, match=r"scan 1 has .* points, but had another number"):
        slam.process(next(ring_dataset.iterate(30, 31)))
    journal.close()


def test_resumed_and_uninterrupted_runs_leave_the_same(killed, ring_folder, ring_run, sl3d):
    result = sl3d("map", ring_folder, "--out", killed, "--resume", "--quiet")
    assert result.returncode == 0, result.stderr
    for name in (*EXACT, "map.sl3d"):
        assert (killed / name).read_bytes() == (ring_run / name).read_bytes(), name
    assert {path.name for path in killed.iterdir()} == {path.name for path in ring_run.iterdir()}

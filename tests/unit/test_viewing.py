"""Views made in another process are those made here; what goes wrong there is said here."""

import os
import signal

import numpy as np
import pytest

from sl3d_slam.config import load_config
from sl3d_slam.errors import InputError, Sl3dError
from sl3d_slam.matching.views import from_bytes, unpack
from sl3d_slam.viewing import ViewMaker, result_of


@pytest.fixture(scope="module")
def maker():
    made = ViewMaker(load_config(), workers=1)
    yield made
    made.close()


def test_a_worker_makes_the_same_view_to_the_byte(maker, ring_dataset):
    scans = [scan.points_lidar for scan in ring_dataset.iterate(3, 5)]
    beside = [maker.start(points) for points in scans]
    here = ViewMaker(load_config())
    for points, future in zip(scans, beside, strict=True):
        assert result_of(future)[0] == result_of(here.start(points))[0]
    view = unpack(from_bytes(result_of(beside[0])[0]))
    assert len(view.lines) > 0
    assert len(view.cloud) == len(view.heights) > 100


def test_an_error_in_the_worker_is_raised_as_itself(maker):
    with pytest.raises(InputError, match="10 points; a scan has at least"):
        result_of(maker.start(np.ones((10, 3))))


def test_a_worker_that_is_killed_is_one_sentence():
    maker = ViewMaker(load_config(), workers=1)
    waiting = maker.start(np.random.default_rng(0).uniform(-30, 30, (100_000, 3)))
    (process,) = maker._pool._processes.values()
    os.kill(process.pid, signal.SIGKILL)
    with pytest.raises(Sl3dError, match="was killed"):
        result_of(waiting)
    with pytest.raises(Sl3dError, match="--workers 0"):
        maker.start(np.ones((200, 3)))
    maker.close()

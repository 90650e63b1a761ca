"""Work done in another process is that done here; what goes wrong there is said here."""

import multiprocessing
import os
import signal
import time

import numpy as np
import pytest

from sl3d_slam.beside import Beside, result_of
from sl3d_slam.closing import LoopCloser
from sl3d_slam.config import load_config
from sl3d_slam.errors import InputError, Sl3dError
from sl3d_slam.graph.chain import OdometryChain
from sl3d_slam.matching.views import from_bytes, unpack


@pytest.fixture(scope="module")
def maker():
    made = Beside(load_config(), workers=1)
    yield made
    made.close()


def test_a_worker_makes_the_same_view_to_the_byte(maker, ring_dataset):
    scans = [scan.points_lidar for scan in ring_dataset.iterate(3, 5)]
    beside = [maker.make_view(points) for points in scans]
    here = Beside(load_config())
    for points, future in zip(scans, beside, strict=True):
        assert result_of(future)[0] == result_of(here.make_view(points))[0]
    view = unpack(from_bytes(result_of(beside[0])[0]))
    assert len(view.lines) > 0
    assert len(view.cloud) == len(view.heights) > 100


@pytest.fixture(scope="module")
def revisit(ring_dataset):
    """What may be loops of a keyframe a lap after the first."""
    chain = OdometryChain(load_config().graph)
    closer = LoopCloser(load_config(), chain)
    for keyframe_id, index in enumerate((2, 20, 46)):
        scan = next(ring_dataset.iterate(index, index + 1))
        chain.append(keyframe_id, ring_dataset.truth[index], 20)
        closer.add(keyframe_id, closer.make_view(scan.points_lidar), ring_dataset.truth[index])
    return closer.candidates(2, {})


def as_numbers(outcomes):
    return [
        (type(o), o.target_id, o.query_id, o.T_target_query.tolist(), o.information.tolist())
        for o in outcomes
    ]


def test_a_worker_verifies_candidates_to_the_same_bit(maker, revisit):
    here = result_of(Beside(load_config()).verify(revisit))
    beside = maker.verify(revisit)
    assert len(here.outcomes) == 1
    assert as_numbers(result_of(beside).outcomes) == as_numbers(here.outcomes)


def test_where_the_worker_is_behind_candidates_are_verified_here(maker, ring_dataset, revisit):
    scans = [scan.points_lidar for scan in ring_dataset.iterate(3, 7)]
    views = [maker.make_view(points) for points in scans]
    verified = maker.verify(revisit)
    assert verified.done()
    assert not views[-1].done()
    assert len(verified.result().outcomes) == 1
    for view in views:
        result_of(view)


def test_an_error_in_the_worker_is_raised_as_itself(maker):
    with pytest.raises(InputError, match="10 points; a scan has at least"):
        result_of(maker.make_view(np.ones((10, 3))))


@pytest.mark.parametrize("wait_s", [0.0, 0.3])  # by then a scan is halfway through the pipe
def test_a_worker_that_is_killed_is_one_sentence(wait_s):
    maker = Beside(load_config(), workers=1)
    waiting = maker.make_view(np.random.default_rng(0).uniform(-30, 30, (100_000, 3)))
    (process,) = maker._pool._processes.values()
    time.sleep(wait_s)
    os.kill(process.pid, signal.SIGKILL)
    with pytest.raises(Sl3dError, match="was killed"):
        result_of(waiting)
    with pytest.raises(Sl3dError, match="--workers 0"):
        maker.make_view(np.ones((200, 3)))
    maker.close()


def test_what_compiles_ends_and_leaves_what_is_wrong_to_be_said_by_the_worker(capfd):
    settings = load_config(None, ["lines.weights=nowhere.safetensors"])
    maker = Beside(settings, workers=1)
    others = set(multiprocessing.active_children())
    maker.compile()
    assert set(multiprocessing.active_children()) <= others
    assert capfd.readouterr().err == ""
    with pytest.raises(InputError, match="nowhere"):
        result_of(maker.make_view(np.ones((200, 3))))
    maker.close()


def test_closing_drops_views_that_no_worker_has_begun(ring_dataset):
    maker = Beside(load_config(), workers=1)
    scans = [scan.points_lidar for scan in ring_dataset.iterate(0, 12)]
    views = [maker.make_view(points) for points in scans]
    maker.close()
    assert all(view.done() for view in views)
    assert views[-1].cancelled()

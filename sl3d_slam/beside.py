"""The work on keyframes, done here or in processes beside this one: their views, their loops.

A view depends on nothing but its scan, and what becomes of candidates on nothing but their views,
so where and when either is worked out changes no result. KISS-ICP and small_gicp hold Python's lock
while they work: threads would only take turns.
"""

import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import cached_property
from typing import Any, NamedTuple, TypeVar

import numpy as np

from sl3d_slam.config import SlamConfig
from sl3d_slam.errors import Sl3dError
from sl3d_slam.geometry.se3 import Points
from sl3d_slam.lines.extract import LineExtractor
from sl3d_slam.matching.views import pack, to_bytes
from sl3d_slam.rehearsal import rehearse_keyframes
from sl3d_slam.types import LoopConstraint, Rejection
from sl3d_slam.verifying import Candidates, verify
from sl3d_slam.viewing import view_of

T = TypeVar("T")


class Made(NamedTuple):
    """A packed view as bytes, the seconds it took, and the model that found its lines."""

    packed: bytes
    seconds: float
    model: str


class Verified(NamedTuple):
    """What became of a keyframe's candidates, and the seconds it took."""

    outcomes: list[LoopConstraint | Rejection]
    seconds: float


def spare_processors() -> int:
    """Return how many processors this process may use besides one."""
    affinity = getattr(os, "sched_getaffinity", None)  # not on macOS
    return (len(affinity(0)) if affinity else os.cpu_count() or 1) - 1


class Beside:
    """Makes packed views of scans and verifies candidates; with workers, beside the caller.

    Worker processes are spawned: a script that asks for them needs the usual
    ``if __name__ == "__main__":``. They end with this process, however it ends.
    """

    def __init__(self, config: SlamConfig, workers: int = 0) -> None:
        self.workers = workers
        self._here = _Bench(config)
        self._begun: list[Future[Any]] = []
        self._rehearsal: Future[None] | None = None
        self._pool: ProcessPoolExecutor | None = None
        if workers > 0:
            spawn = multiprocessing.get_context("spawn")
            self._pool = ProcessPoolExecutor(workers, spawn, _begin, (config,))
            self._rehearsal = self._begin(_rehearse)

    @property
    def is_ready(self) -> bool:
        """Whether nothing is left to be loaded or compiled before the work begins."""
        return self._rehearsal is not None and self._rehearsal.done()

    def get_ready(self) -> None:
        """Load and compile what the work needs, or wait for the workers that do so."""
        if self._rehearsal is None:
            self._here.rehearse()
            self._rehearsal = _done(None)
        result_of(self._rehearsal)

    def make_view(self, points_lidar: Points) -> "Future[Made]":
        """Begin a view; without workers it is done on return, and errors are raised here."""
        if self.workers > 0:
            return self._begin(_make, _halved(points_lidar))
        return _done(self._here.make(points_lidar))

    def verify(self, candidates: Candidates) -> "Future[Verified]":
        """Begin to verify candidates; done on return without workers, or where they are behind."""
        if len(candidates) == 0:
            return _done(Verified([], 0.0))
        self._begun = [future for future in self._begun if not future.done()]
        if self.workers > 0 and len(self._begun) <= self.workers:
            return self._begin(_verify, candidates)
        return _done(self._here.verify(candidates))

    def close(self) -> None:
        """End the processes; what was not begun is dropped."""
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)

    def _begin(self, work: Callable[..., T], *argument: Any) -> "Future[T]":
        assert self._pool is not None
        with _death_explained():
            begun = self._pool.submit(work, *argument)
        self._begun.append(begun)
        return begun


def _halved(points_lidar: Points) -> np.ndarray:
    """Return points as float32 where that is exact, as they are in most files; a scan is large."""
    short = points_lidar.astype(np.float32)
    return short if (short == points_lidar).all() else points_lidar


def _done(result: T) -> "Future[T]":
    future: Future[T] = Future()
    future.set_result(result)
    return future


def result_of(future: "Future[T]") -> T:
    """Wait for what was begun; an error in the worker is raised as itself.

    Raises
    ------
    Sl3dError
        where the process died.
    """
    with _death_explained():
        return future.result()


@contextmanager
def _death_explained() -> Iterator[None]:
    try:
        yield
    except BrokenProcessPool:
        raise Sl3dError(
            "the process that finds lines and loops was killed, perhaps for want of memory; "
            "--workers 0 does without one"
        ) from None


class _Bench:
    """Where the work is done: settings and an extractor, which loads when it is first needed."""

    def __init__(self, config: SlamConfig) -> None:
        self._config = config

    @cached_property
    def extractor(self) -> LineExtractor:
        """The line extractor of the settings."""
        return LineExtractor(self._config.lines)

    def rehearse(self) -> None:
        """Do everything once, on a made-up scan."""
        rehearse_keyframes(self.extractor, self._config)

    def make(self, points_lidar: Points) -> Made:
        """Make a packed view."""
        start_s = time.perf_counter()
        raw = to_bytes(pack(view_of(points_lidar, self.extractor, self._config)))
        return Made(raw, time.perf_counter() - start_s, self.extractor.model)

    def verify(self, candidates: Candidates) -> Verified:
        """Verify candidates."""
        start_s = time.perf_counter()
        outcomes = verify(candidates, self._config)
        return Verified(outcomes, time.perf_counter() - start_s)


_bench: _Bench | None = None  # of a worker process


def _begin(config: SlamConfig) -> None:
    """Set up a worker process: Ctrl-C is its parent's business, and so is its life."""
    global _bench
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    _bench = _Bench(config)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def _rehearse() -> None:
    assert _bench is not None
    _bench.rehearse()


def _make(points_lidar: np.ndarray) -> Made:
    assert _bench is not None
    return _bench.make(points_lidar.astype(np.float64))


def _verify(candidates: Candidates) -> Verified:
    assert _bench is not None
    return _bench.verify(candidates)

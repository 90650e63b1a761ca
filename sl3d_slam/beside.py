"""The work on keyframes, done here or in processes beside this one: their views, their loops.

A view depends on nothing but its scan, and what becomes of candidates on nothing but their views,
so where and when either is worked out changes no result. KISS-ICP and small_gicp hold Python's lock
while they work: threads would only take turns.
"""

import multiprocessing
import os
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from typing import Any, TypeVar

import numpy as np

from sl3d_slam import worker
from sl3d_slam.config import SlamConfig
from sl3d_slam.errors import Sl3dError
from sl3d_slam.geometry.se3 import Points
from sl3d_slam.memory import children_peak_mb
from sl3d_slam.verifying import Candidates
from sl3d_slam.worker import Made, Verified, Workbench

T = TypeVar("T")
SPAWN = multiprocessing.get_context("spawn")


def default_workers() -> int:
    """Return one worker, or none where this process may use but one processor."""
    affinity = getattr(os, "sched_getaffinity", None)  # not on macOS
    processors = len(affinity(0)) if affinity else os.cpu_count() or 1
    return min(1, processors - 1)


class Beside:
    """Makes packed views of scans and verifies candidates; with workers, beside the caller.

    Worker processes are spawned: a script that asks for them needs the usual
    ``if __name__ == "__main__":``. They end with this process, however it ends.
    """

    def __init__(self, config: SlamConfig, workers: int = 0) -> None:
        self.workers = workers
        self.workers_peak_mb = 0.0
        self._here = Workbench(config)
        self._begun: list[Future[Any]] = []
        self._rehearsal: Future[None] | None = None
        self._pool: ProcessPoolExecutor | None = None
        self._config = config

    @property
    def is_ready(self) -> bool:
        """Whether nothing is left to be loaded or compiled before the work begins."""
        return self._rehearsal is not None and self._rehearsal.done()

    def compile(self) -> None:
        """Compile all that a run needs, in a process that ends where there are workers.

        A compiler keeps a quarter of a gigabyte of memory.
        """
        if self.workers > 0:
            process = SPAWN.Process(target=worker.compile_all, args=(self._config,), daemon=True)
            process.start()
            process.join()

    def start(self) -> None:
        """Have the workers load what they need; without workers load it here."""
        if self._rehearsal is not None:
            return
        if self.workers > 0:
            self._pool = ProcessPoolExecutor(self.workers, SPAWN, worker.begin, (self._config,))
            self._rehearsal = self._begin(worker.rehearse)
        else:
            self._here.rehearse()
            self._rehearsal = _done(None)

    def make_view(self, points_lidar: Points) -> "Future[Made]":
        """Begin a view; without workers it is done on return, and errors are raised here."""
        if self.workers > 0:
            return self._begin(worker.make_view, _halved(points_lidar))
        return _done(self._here.make_view(points_lidar))

    def verify(self, candidates: Candidates) -> "Future[Verified]":
        """Begin to verify candidates; done on return without workers, or where they are behind."""
        if len(candidates) == 0:
            return _done(Verified([], 0.0))
        behind = sum(not future.done() for future in self._begun) > self.workers
        if self.workers > 0 and not behind:
            return self._begin(worker.verify_candidates, candidates)
        return _done(self._here.verify(candidates))

    def close(self) -> None:
        """End the processes; what was not begun is dropped. Notes the most that they held."""
        if self._pool is not None:
            self.workers_peak_mb = max(self.workers_peak_mb, children_peak_mb())
            _stop_feeding_the_dead(self._pool)
            self._pool.shutdown(cancel_futures=True)

    def _begin(self, work: Callable[..., T], *argument: Any) -> "Future[T]":
        if self._pool is None:
            self.start()
        assert self._pool is not None
        with _death_explained():
            begun = self._pool.submit(work, *argument)
        self._begun = [*(future for future in self._begun if not future.done()), begun]
        return begun


def _stop_feeding_the_dead(pool: ProcessPoolExecutor) -> None:
    """Close the pipe that a killed process no longer reads: a scan may be halfway through it.

    Before Python 3.12.1 the pool itself waits for ever to get rid of it (CPython issue 94777).
    """
    processes = getattr(pool, "_processes", None) or {}
    if getattr(pool, "_broken", False) or not all(p.is_alive() for p in processes.values()):
        pool._call_queue._reader.close()  # type: ignore[attr-defined]


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

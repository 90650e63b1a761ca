"""What is done on keyframes, and the processes in which it may be done."""

import multiprocessing
import os
import signal
import threading
import time
from contextlib import suppress
from functools import cached_property
from typing import NamedTuple

import numpy as np

from sl3d_slam.config import SlamConfig
from sl3d_slam.errors import Sl3dError
from sl3d_slam.geometry.se3 import Points
from sl3d_slam.lines.extract import LineExtractor
from sl3d_slam.matching.views import pack, to_bytes
from sl3d_slam.memory import keep_large_arrays_apart
from sl3d_slam.rehearsal import rehearse_constellations, rehearse_keyframes
from sl3d_slam.types import LoopConstraint, Rejection
from sl3d_slam.verifying import Candidates, verify
from sl3d_slam.viewing import view_of


class Made(NamedTuple):
    """A packed view as bytes, the seconds it took, and the model that found its lines."""

    packed: bytes
    seconds: float
    model: str


class Verified(NamedTuple):
    """What became of a keyframe's candidates, and the seconds it took."""

    outcomes: list[LoopConstraint | Rejection]
    seconds: float


class Workbench:
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

    def make_view(self, points_lidar: Points) -> Made:
        """Make a packed view."""
        start_s = time.perf_counter()
        raw = to_bytes(pack(view_of(points_lidar, self.extractor, self._config)))
        return Made(raw, time.perf_counter() - start_s, self.extractor.model)

    def verify(self, candidates: Candidates) -> Verified:
        """Verify candidates."""
        start_s = time.perf_counter()
        outcomes = verify(candidates, self._config)
        return Verified(outcomes, time.perf_counter() - start_s)


_workbench: Workbench | None = None  # of a worker process


def begin(config: SlamConfig) -> None:
    """Set up a worker process: Ctrl-C is its parent's business, and so is its life."""
    global _workbench
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    keep_large_arrays_apart()
    threading.Thread(target=_end_with_parent, daemon=True).start()
    _workbench = Workbench(config)


def rehearse() -> None:
    """Do everything once in this worker."""
    assert _workbench is not None
    _workbench.rehearse()


def make_view(points_lidar: np.ndarray) -> Made:
    """Make a packed view in this worker."""
    assert _workbench is not None
    return _workbench.make_view(points_lidar.astype(np.float64))


def verify_candidates(candidates: Candidates) -> Verified:
    """Verify candidates in this worker."""
    assert _workbench is not None
    return _workbench.verify(candidates)


def compile_all(config: SlamConfig) -> None:
    """Be a process that only compiles; what is wrong is said by those that do the work."""
    begin(config)
    with suppress(Sl3dError):
        rehearse()
    rehearse_constellations()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)

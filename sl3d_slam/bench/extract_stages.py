"""How long each stage of line extraction takes, told from outside: the extractor knows no clock."""

import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib import import_module
from typing import Any

# stage, module that uses it, name there
Stage = tuple[str, str, str]
_LEARNED, _INFERENCE = "sl3d_slam.lines.learned", "sl3d_slam.lines.network.inference"
_GEOMETRIC = "sl3d_slam.lines.geometric"
_PROPOSING: tuple[Stage, ...] = (
    ("poles", _GEOMETRIC, "find_poles"),
    ("edges", _GEOMETRIC, "find_edges"),
)
STAGES: Mapping[str, Sequence[Stage]] = {
    "geometric": (
        ("scene", _GEOMETRIC, "make_scene"),
        *_PROPOSING,
        ("describing", _GEOMETRIC, "describe_uprights"),
    ),
    "learned": (
        ("scene", _LEARNED, "make_scene"),
        ("network points", _LEARNED, "network_points"),
        ("neighbours", _INFERENCE, "skip_neighbours"),
        ("forward", _INFERENCE, "Network.infer"),
        *_PROPOSING,
        ("growing", "sl3d_slam.lines.grown", "_join"),
        ("fitting", "sl3d_slam.lines.grown", "_fit"),
        ("ranking", _LEARNED, "points_along"),
        ("describing", _LEARNED, "_describe"),
    ),
}


class Stopwatch:
    """Sums up the processor seconds of stages; what a stage calls counts for the inner one only.

    Each thread is timed by itself.
    """

    def __init__(self, clock: Callable[[], float] = time.thread_time) -> None:
        self._clock = clock
        self._thread = threading.local()
        self.taken_s: dict[str, float] = defaultdict(float)

    def timed(self, stage: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return a function that does the same and is timed."""

        def run(*arguments: Any, **named: Any) -> Any:
            inner_s: list[float] = self._thread.__dict__.setdefault("inner_s", [0.0])
            start_s = self._clock()
            inner_s.append(0.0)
            try:
                return function(*arguments, **named)
            finally:
                total_s = self._clock() - start_s
                self.taken_s[stage] += total_s - inner_s.pop()
                inner_s[-1] += total_s

        return run

    @contextmanager
    def watching(self, stages: Sequence[Stage]) -> Iterator[None]:
        """Time the functions named while in the body; afterwards all is as it was."""
        replaced = []
        for stage, module, path in stages:
            holder: Any = import_module(module)
            *classes, name = path.split(".")
            for part in classes:
                holder = getattr(holder, part)
            replaced.append((holder, name, getattr(holder, name)))
            setattr(holder, name, self.timed(stage, getattr(holder, name)))
        try:
            yield
        finally:
            for holder, name, function in reversed(replaced):
                setattr(holder, name, function)

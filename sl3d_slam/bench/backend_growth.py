"""How long an update of the live pose graph takes as the graph grows."""

from collections.abc import Callable
from itertools import pairwise

import numpy as np

from sl3d_slam.bench.backend_methods import Times, drive_live
from sl3d_slam.bench.backend_world import SETTINGS, built_in_drive, make_world
from sl3d_slam.bench.tables import Column, Row

LOOP_EVERY = 25  # poses between loops
SHARE_FALSE = 0.1
STRETCH = 1_000  # poses between two words of progress
NUM_ROWS = 10

GROWTH_COLUMNS = (
    Column("num_keyframes", "keyframes so far", "{:d}"),
    Column("median_ms", "median ms", "{:.2f}"),
    Column("p90_ms", "90 % ms", "{:.1f}"),
    Column("p99_ms", "99 % ms", "{:.1f}"),
    Column("max_ms", "worst ms", "{:.0f}"),
)


def grow(
    num_keyframes: int, seed: int, progress: Callable[[int], None] = lambda done: None
) -> list[Row]:
    """Time each update of a graph that grows to ``num_keyframes`` with a loop every 25.

    One row a tenth of them; ``progress`` is told every 1,000 keyframes how many are there.
    """
    truth = built_in_drive(num_keyframes)
    world = make_world(truth, num_keyframes // LOOP_EVERY, SHARE_FALSE, "random", seed)

    def count(done: int) -> None:
        if done % STRETCH == 0:
            progress(done)

    _, updates_ms = drive_live(world, SETTINGS, count)
    ends = np.linspace(0, num_keyframes, NUM_ROWS + 1).astype(int)
    return [_row(int(end), updates_ms[start:end]) for start, end in pairwise(ends)]


def _row(num_keyframes: int, updates_ms: Times) -> Row:
    return {
        "num_keyframes": num_keyframes,
        "median_ms": float(np.median(updates_ms)),
        "p90_ms": float(np.percentile(updates_ms, 90)),
        "p99_ms": float(np.percentile(updates_ms, 99)),
        "max_ms": float(updates_ms.max()),
    }

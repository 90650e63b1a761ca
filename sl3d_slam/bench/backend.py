"""``sl3d bench backend``: which back end survives false loops, at what cost.

Everything here is simulated: the drive is built in or a KITTI ground truth, its odometry drifts
and its loops are drawn at random, so that truth and falsehood are known.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sl3d_slam.bench.backend_growth import GROWTH_COLUMNS, STRETCH, grow
from sl3d_slam.bench.backend_methods import METHODS, BackendAnswer
from sl3d_slam.bench.backend_picture import draw_growth, draw_results
from sl3d_slam.bench.backend_world import (
    SETTINGS,
    BackendWorld,
    Poses,
    built_in_drive,
    make_world,
    read_kitti_drive,
)
from sl3d_slam.bench.tables import Column, Row, Table, write_tables
from sl3d_slam.errors import GraphError
from sl3d_slam.files import prepare_run_folder, write_whole
from sl3d_slam.report.metrics import ate_rmse_m

KINDS = ("random", "aliased")
Progress = Callable[[str, int], None]

COLUMNS = (
    Column("kind", "false loops"),
    Column("share_false", "share", "{:.0%}"),
    Column("method", "method"),
    Column("ate_m", "ATE m", "{:.3f}"),
    Column("by_oracle", "by the oracle's", "{:.3f}"),
    Column("kept_true", "true kept"),
    Column("kept_false", "false kept"),
    Column("seconds", "processor s", "{:.1f}"),
    Column("update_median_ms", "ms a keyframe, median", "{:.2f}", main=False),
    Column("update_max_ms", "worst", "{:.0f}", main=False),
)
NOTES = (
    "Kept: of all; empty where a method keeps every loop and only weighs it.",
    "ATE inf: gtsam gave up, or the poses ran away.",
)


@dataclass(frozen=True, slots=True)
class Extent:
    """How much is done; ``stride`` takes every so many poses of the drive."""

    shares: tuple[float, ...]
    num_true: int
    stride: int
    num_growing: int


FULL = Extent((0.0, 0.1, 0.3, 0.5, 0.6, 0.7), num_true=200, stride=1, num_growing=50_000)
QUICK = Extent((0.0, 0.5, 0.7), num_true=80, stride=5, num_growing=2_000)
MAX_POSES = 4541


def num_steps(extent: Extent) -> int:
    """Return how many steps of progress a run takes."""
    return len(KINDS) * len(extent.shares) * len(METHODS) + extent.num_growing // STRETCH


def run(
    out: Path,
    extent: Extent = FULL,
    trajectory: Path | None = None,
    seed: int = 1,
    command: str = "sl3d bench backend",
    progress: Progress = lambda note, steps: None,
) -> list[Table]:
    """Compare the back ends; leave ``backend.md``, tables as CSV and pictures in ``out``.

    Tables are written after every world, so an interrupted run leaves what it found. Times are
    those of the processor.

    Parameters
    ----------
    trajectory : KITTI pose file to drive along; None for the built-in drive.
    seed : of drift and loops.

    Raises
    ------
    InputError
        where the trajectory cannot be read.
    OutputError
        where ``out`` cannot be written.
    """
    prepare_run_folder(out)
    truth = read_kitti_drive(trajectory) if trajectory else built_in_drive(MAX_POSES)
    truth = truth[: MAX_POSES : extent.stride]
    drive = f"{len(truth)} poses of {trajectory.name if trajectory else 'the built-in drive'}"
    rows: list[Row] = []
    results = Table(f"Back ends against false loops (simulated: {drive})", COLUMNS, rows, NOTES)
    for kind in KINDS:
        for share in extent.shares:
            world = make_world(truth, extent.num_true, share, kind, seed)
            rows += compare(world, kind, share, progress)
            write_tables(out, "backend", [results], command)
    write_whole(out / "backend.png", draw_results(rows))
    grown = grow(extent.num_growing, seed, lambda done: progress(f"{done} keyframes", 1))
    growth = Table("Time of an update as the graph grows", GROWTH_COLUMNS, grown)
    write_whole(out / "backend_growth.png", draw_growth(grown))
    write_tables(out, "backend", [results, growth], command)
    return [results, growth]


def compare(
    world: BackendWorld,
    kind: str,
    share_false: float,
    progress: Progress = lambda note, steps: None,
) -> list[Row]:
    """Run every method over one world."""
    drift_m = ate_rmse_m(world.T_odom_lidar, world.T_world_lidar)
    common = {"kind": kind, "share_false": share_false, "odometry_ate_m": drift_m}
    rows: list[Row] = []
    for method, solve in METHODS.items():
        start_s = time.process_time()
        try:
            answer = solve(world, SETTINGS)
        except GraphError:  # gtsam gives up on a diverging peer
            answer = BackendAnswer(np.full_like(world.T_odom_lidar, np.nan), None)
        seconds = time.process_time() - start_s
        ate_m = _ate_or_inf(answer.T_world_lidar, world.T_world_lidar)
        oracle_m = rows[0]["ate_m"] if rows else ate_m
        figures = {"ate_m": ate_m, "by_oracle": ate_m / oracle_m, "seconds": seconds}
        rows.append(
            {**common, "method": method, **figures, **_kept(answer, world), **_times(answer)}
        )
        progress(f"{kind} {share_false:.0%} {method}", 1)
    return rows


def _kept(answer: BackendAnswer, world: BackendWorld) -> Row:
    if answer.kept is None:
        return {}
    is_true = np.array(world.is_true, dtype=bool)
    return {
        "kept_true": f"{np.sum(answer.kept & is_true)}/{is_true.sum()}",
        "kept_false": f"{np.sum(answer.kept & ~is_true)}/{np.sum(~is_true)}",
    }


def _times(answer: BackendAnswer) -> Row:
    if answer.updates_ms is None:
        return {}
    median_ms, max_ms = float(np.median(answer.updates_ms)), float(answer.updates_ms.max())
    return {"update_median_ms": median_ms, "update_max_ms": max_ms}


def _ate_or_inf(estimate: Poses, truth: Poses) -> float:
    return ate_rmse_m(estimate, truth) if np.isfinite(estimate).all() else float("inf")

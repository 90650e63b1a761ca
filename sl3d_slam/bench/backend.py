"""``sl3d bench backend``: which back end survives false loops, at what cost.

Everything here is simulated: the drive is built in or a KITTI ground truth, its odometry drifts
and its loops are drawn at random, so that truth and falsehood are known.
"""

import csv
import io
import time
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np

from sl3d_slam.bench.backend_methods import METHODS
from sl3d_slam.bench.backend_picture import draw_growth, draw_results
from sl3d_slam.bench.backend_world import (
    SETTINGS,
    BackendWorld,
    Poses,
    built_in_drive,
    make_world,
    read_kitti_drive,
)
from sl3d_slam.errors import GraphError
from sl3d_slam.files import prepare_run_folder, write_whole
from sl3d_slam.graph.pose_graph import PoseGraph
from sl3d_slam.report.metrics import ate_rmse_m

NUM_TRUE, QUICK_TRUE = 200, 80
FULL_SHARES = (0.0, 0.1, 0.3, 0.5, 0.6, 0.7)
QUICK_SHARES = (0.0, 0.5, 0.7)
FULL_POSES, QUICK_STRIDE = 4541, 5  # quick: every fifth pose of the same drive
FULL_GROWTH, QUICK_GROWTH = 50_000, 2_000
LOOP_EVERY = 25  # poses between loops while the graph grows


@dataclass(frozen=True, slots=True)
class BackendRow:
    """One method in one world; counts are None where a method only down-weights."""

    kind: str
    share_false: float
    method: str
    ate_m: float
    odometry_ate_m: float
    true_kept: int | None
    num_true: int
    false_kept: int | None
    num_false: int
    seconds: float


@dataclass(frozen=True, slots=True)
class GrowthRow:
    """Time per update (keyframe and its loops) within a stretch of a growing graph."""

    num_keyframes: int
    median_ms: float
    p99_ms: float
    max_ms: float


def run(out: Path, quick: bool, trajectory: Path | None = None, seed: int = 1) -> list[BackendRow]:
    """Compare the back ends; leave ``backend.csv``, ``.md``, ``.png`` and growth files in ``out``.

    Tables are written after every world, so an interrupted run leaves what it found. Times are
    those of the processor.

    Parameters
    ----------
    out : folder for the results, made where absent.
    quick : every fifth pose and fewer shares, a minute instead of half an hour.
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
    truth = read_kitti_drive(trajectory) if trajectory else built_in_drive(FULL_POSES)
    truth = truth[:FULL_POSES:QUICK_STRIDE] if quick else truth[:FULL_POSES]
    num_true = QUICK_TRUE if quick else NUM_TRUE
    drive = f"{len(truth)} poses of {trajectory.name if trajectory else 'the built-in drive'}"
    rows: list[BackendRow] = []
    for kind in ("random", "aliased"):
        for share in QUICK_SHARES if quick else FULL_SHARES:
            rows += compare(make_world(truth, num_true, share, kind, seed), kind, share)
            write_whole(out / "backend.csv", _csv(rows))
            write_whole(out / "backend.md", _markdown(rows, [], drive))
    write_whole(out / "backend.png", draw_results(rows))
    growth = grow(QUICK_GROWTH if quick else FULL_GROWTH, seed)
    write_whole(out / "backend_growth.csv", _csv(growth))
    write_whole(out / "backend_growth.png", draw_growth(growth))
    write_whole(out / "backend.md", _markdown(rows, growth, drive))
    return rows


def compare(world: BackendWorld, kind: str, share_false: float) -> list[BackendRow]:
    """Run every method over one world."""
    is_true = np.array(world.is_true, dtype=bool)
    odometry_ate_m = ate_rmse_m(world.T_odom_lidar, world.T_world_lidar)
    rows = []
    for method, solve in METHODS.items():
        start_s = time.process_time()
        kept: np.ndarray | None = None
        try:
            answer = solve(world, SETTINGS)
            ate_m, kept = _ate_or_inf(answer.T_world_lidar, world.T_world_lidar), answer.kept
        except GraphError:  # gtsam gives up on a diverging peer
            ate_m = float("inf")
        rows.append(
            BackendRow(
                kind=kind,
                share_false=share_false,
                method=method,
                ate_m=ate_m,
                odometry_ate_m=odometry_ate_m,
                true_kept=None if kept is None else int(np.sum(kept & is_true)),
                num_true=int(is_true.sum()),
                false_kept=None if kept is None else int(np.sum(kept & ~is_true)),
                num_false=int(np.sum(~is_true)),
                seconds=time.process_time() - start_s,
            )
        )
    return rows


def grow(num_keyframes: int, seed: int) -> list[GrowthRow]:
    """Time each update of a graph that grows to ``num_keyframes`` with a loop every 25."""
    truth = built_in_drive(num_keyframes)
    world = make_world(truth, num_keyframes // LOOP_EVERY, 0.1, "random", seed)
    graph = PoseGraph(SETTINGS)
    taken_ms = np.zeros(num_keyframes)
    offered = 0
    for scan, pose in enumerate(world.T_odom_lidar):
        start_s = time.process_time()
        graph.add_keyframe(scan, pose, 1)
        while offered < len(world.loops) and world.loops[offered].query_id == scan:
            graph.add_loop(world.loops[offered])
            offered += 1
        taken_ms[scan] = 1e3 * (time.process_time() - start_s)
    stretch = max(1, num_keyframes // 10)
    return [
        GrowthRow(
            num_keyframes=min(first + stretch, num_keyframes),
            median_ms=float(np.median(taken_ms[first : first + stretch])),
            p99_ms=float(np.percentile(taken_ms[first : first + stretch], 99)),
            max_ms=float(taken_ms[first : first + stretch].max()),
        )
        for first in range(0, num_keyframes, stretch)
    ]


def _ate_or_inf(estimate: Poses, truth: Poses) -> float:
    return ate_rmse_m(estimate, truth) if np.isfinite(estimate).all() else float("inf")


def _csv(rows: list[BackendRow] | list[GrowthRow]) -> str:
    buffer = io.StringIO()
    names = [field.name for field in fields(rows[0])]
    writer = csv.DictWriter(buffer, names, lineterminator="\n")
    writer.writeheader()
    writer.writerows(asdict(row) for row in rows)
    return buffer.getvalue()


def _markdown(rows: list[BackendRow], growth: list[GrowthRow], drive: str) -> str:
    lines = [
        f"# Back ends against false loops (simulated: {drive})",
        "",
        "| false loops | share | method | ATE m | true kept | false kept | processor s |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        true_kept = "all, weighted" if row.true_kept is None else f"{row.true_kept}/{row.num_true}"
        false_kept = (
            "all, weighted" if row.false_kept is None else f"{row.false_kept}/{row.num_false}"
        )
        lines.append(
            f"| {row.kind} | {row.share_false:.0%} | {row.method} | {row.ate_m:.2f} "
            f"| {true_kept} | {false_kept} | {row.seconds:.1f} |"
        )
    lines += ["", f"Odometry alone: {rows[0].odometry_ate_m:.2f} m."]
    if growth:
        lines += [
            "",
            "| keyframes so far | median ms | 99th percentile ms | worst ms |",
            "|---|---|---|---|",
        ]
    lines += [
        f"| {row.num_keyframes} | {row.median_ms:.2f} | {row.p99_ms:.1f} | {row.max_ms:.0f} |"
        for row in growth
    ]
    return "\n".join(lines) + "\n"

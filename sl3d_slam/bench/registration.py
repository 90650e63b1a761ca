"""``sl3d bench registration``: scans some distance apart, no first guess, beside the peers."""

import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from sl3d_slam.bench.process import run_runner
from sl3d_slam.bench.registration_figures import COLUMNS, NOTES, figures
from sl3d_slam.bench.registration_methods import Attempt
from sl3d_slam.bench.registration_pictures import draw_curves, draw_iterations, draw_recall
from sl3d_slam.bench.registration_plan import Plan, RegistrationBench
from sl3d_slam.bench.registration_runner import to_attempts
from sl3d_slam.bench.tables import Row, Table, write_tables
from sl3d_slam.files import prepare_run_folder, write_whole

RUNNER = "sl3d_slam.bench.registration_runner"

Progress = Callable[[str, int], None]


def run(
    bench: RegistrationBench,
    plan: Plan,
    out: Path,
    command: str = "sl3d bench registration",
    progress: Progress = lambda note, steps: None,
) -> Table:
    """Register every pair by every method, one process a method; leave tables and pictures.

    Raises
    ------
    OutputError
        where ``out`` cannot be written.
    """
    prepare_run_folder(out)
    rows: list[Row] = []
    answers: dict[str, list[list[Attempt]]] = {}
    for method in bench.methods:
        status, attempts = _attempts(bench, plan, method, progress)
        if attempts:
            answers[method] = attempts
        rows += list(_rows(plan, method, status, attempts))
    rows.sort(key=lambda row: [group.name for group in plan.groups].index(row["pairs_of"]))
    source = f"truth {bench.truth}, tilt up to {bench.tilt_deg:g} deg, seed {bench.seed}"
    table = Table(f"Registration of two scans ({source})", COLUMNS, rows, NOTES)
    write_tables(out, "registration", [table], command)
    label = " (simulated)" if plan.simulated else ""
    write_whole(out / "registration.png", draw_recall(rows, label))
    write_whole(out / "registration_curves.png", draw_curves(plan.groups, answers, label))
    if bench.iterations:
        write_whole(out / "registration_ransac.png", draw_iterations(rows, label))
    return table


def _attempts(
    bench: RegistrationBench, plan: Plan, method: str, progress: Progress
) -> tuple[str, list[list[Attempt]]]:
    task: dict[str, Any] = {
        "method": method,
        "config": bench.config.model_dump(),
        "seed": bench.seed,
        "drives": {key: asdict(drive) for key, drive in plan.places.items()},
        "pairs": [asdict(pair) for group in plan.groups for pair in group.pairs],
    }
    with tempfile.TemporaryDirectory(prefix="sl3d_bench_") as folder:
        end = run_runner(RUNNER, Path(folder), task, lambda steps: progress(method, steps))
    if end.problem:
        return end.problem, []
    left = iter(to_attempts(end.answer["attempts"]))
    return "ok", [[next(left) for _ in group.pairs] for group in plan.groups]


def _rows(
    plan: Plan, method: str, status: str, attempts: Sequence[Sequence[Attempt]]
) -> Iterator[Row]:
    for k, group in enumerate(plan.groups):
        row = {
            "pairs_of": group.name,
            "kind": "simulated" if plan.simulated else "real",
            "method": method,
            "status": status,
        }
        truths = [pair.truth for pair in group.pairs]
        yield {**row, **figures(attempts[k], truths)} if attempts else row

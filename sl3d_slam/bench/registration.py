"""``sl3d bench registration``: scans some distance apart, no first guess, beside the peers."""

import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from sl3d_slam.bench.process import run_runner
from sl3d_slam.bench.registration_figures import COLUMNS, NOTES, PEER_PAIRS, figures
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
    for methods in bench.processes:
        status, found = _attempts(bench, plan, methods, progress)
        answers |= found
        for method in methods:
            rows += list(_rows(plan, method, status, found.get(method, [])))
    rows.sort(key=lambda row: [group.name for group in plan.groups].index(row["pairs_of"]))
    source = f"truth {bench.truth}, tilt up to {bench.tilt_deg:g} deg, seed {bench.seed}"
    notes = NOTES if bench.peer_pairs is None else (*NOTES, PEER_PAIRS.format(bench.peer_pairs))
    table = Table(f"Registration of two scans ({source})", COLUMNS, rows, notes)
    write_tables(out, "registration", [table], command)
    label = " (simulated)" if plan.simulated else ""
    measured = [row["method"] for row in rows if row.get("recall_percent") is not None]
    if measured:
        write_whole(out / "registration.png", draw_recall(rows, label))
        write_whole(out / "registration_curves.png", draw_curves(plan.groups, answers, label))
    if any("@" in method for method in measured):
        write_whole(out / "registration_ransac.png", draw_iterations(rows, label))
    return table


def _attempts(
    bench: RegistrationBench, plan: Plan, methods: Sequence[str], progress: Progress
) -> tuple[str, dict[str, list[list[Attempt]]]]:
    """Run one process; return its status and, where it is ok, attempts by method and group."""
    groups = [bench.pairs_for(methods, group.pairs) for group in plan.groups]
    task: dict[str, Any] = {
        "methods": methods,
        "config": bench.config.model_dump(),
        "seed": bench.seed,
        "drives": {key: asdict(drive) for key, drive in plan.places.items()},
        "pairs": [asdict(pair) for pairs in groups for pair in pairs],
    }
    with tempfile.TemporaryDirectory(prefix="sl3d_bench_") as folder:
        end = run_runner(RUNNER, Path(folder), task, lambda steps: progress(methods[0], steps))
    if end.problem:
        return end.problem, {}
    found = {}
    for k, method in enumerate(methods):
        left = iter(to_attempts([tree[k] for tree in end.answer["attempts"]]))
        found[method] = [[next(left) for _ in pairs] for pairs in groups]
    return "ok", found


def _rows(
    plan: Plan, method: str, status: str, attempts: Sequence[Sequence[Attempt]]
) -> Iterator[Row]:
    for k, group in enumerate(plan.groups):
        row: dict[str, Any] = {
            "pairs_of": group.name,
            "kind": "simulated" if plan.simulated else "real",
            "method": method,
            "status": status,
        }
        if attempts:
            truths = [pair.truth for pair in group.pairs[: len(attempts[k])]]
            row.update(figures(attempts[k], truths))
        yield row

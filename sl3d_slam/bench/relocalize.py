"""Relocalization in maps of ten thousand to a million lines: time, memory, and who is found."""

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sl3d_slam.bench.process import run_runner
from sl3d_slam.bench.relocalize_reliability import reliability
from sl3d_slam.bench.relocalize_tiles import lay_out
from sl3d_slam.bench.relocalize_world import OTHER_TOWN, Query, map_town, write_queries
from sl3d_slam.bench.tables import Column, Table, write_tables
from sl3d_slam.config import SlamConfig
from sl3d_slam.files import prepare_run_folder
from sl3d_slam.geometry.se3 import Transform
from sl3d_slam.mapping.facts import street_steps
from sl3d_slam.mapping.line_map import LineMap

RUNNER = "sl3d_slam.bench.relocalize_runner"
RIGHT_M, RIGHT_DEG = 2.0, 5.0
NOTES = (
    "Towns are simulated and mapped from scans at their true poses; scans of another day, half of "
    "them driven the other way, each turned at random, are asked once. Right: within 2 m and 5 "
    "deg. Outside: scans of a town that is not in the map.",
    "The towns asked for stand in the map once; the rest of it is the same towns stretched by 6 to "
    "25 % along either axis, each time by other factors, half of them mirrored.",
    "ms: processor time of one thread after extraction of lines and coarse cloud; places are not "
    "in memory before. Retrieval is the part that sees the whole map.",
    "MB: resident, all of the process; 'map' is what loading added, the file's pages included.",
)
COLUMNS = (
    Column("lines", "lines"),
    Column("street_km", "km", "{:.0f}"),
    Column("file_mb", "file MB", "{:.1f}", main=False),
    Column("load_s", "load s", "{:.1f}", main=False),
    Column("index_s", "index s", "{:.1f}", main=False),
    Column("triangles", "triangles", main=False),
    Column("load_mb", "map MB", "{:.0f}", main=False),
    Column("resident_mb", "MB", "{:.0f}"),
    Column("asked", "asked"),
    Column("right", "right"),
    Column("wrong", "wrong"),
    Column("median_m", "median m", "{:.3f}"),
    Column("outside", "outside"),
    Column("placed", "placed"),
    Column("retrieval_ms", "retrieval ms", "{:.1f}"),
    Column("retrieval_p99_ms", "p99", "{:.1f}", main=False),
    Column("latency_ms", "ms", "{:.0f}"),
    Column("latency_p99_ms", "p99 ms", "{:.0f}"),
    Column("status", "status"),
)

Progress = Callable[[str, int], None]


@dataclass(frozen=True, slots=True)
class RelocalizeBench:
    """What is run: sizes of maps in lines, towns, scans of each town and outside."""

    num_lines: Sequence[int]
    num_towns: int
    num_queries: int
    seed: int
    road: str
    sensor: str
    config: SlamConfig


def run(
    bench: RelocalizeBench,
    out: Path,
    command: str = "sl3d bench relocalize",
    progress: Progress = lambda note, steps: None,
) -> Table:
    """Map the towns, lay out a map of each size, ask every scan; tables and maps in ``out``.

    Raises
    ------
    OutputError
        where ``out`` cannot be written.
    """
    prepare_run_folder(out)
    towns, rows, found = [], [], []
    with tempfile.TemporaryDirectory(prefix="sl3d_bench_") as name:
        folder, queries = Path(name), []
        for town in range(bench.num_towns):
            towns.append(_town(bench, town, progress))
            queries += _queries(bench, folder, bench.seed + town, town)
        queries += _queries(bench, folder, bench.seed + OTHER_TOWN, -1)
        for num_lines in bench.num_lines:
            row, answers = _measured(bench, towns, queries, int(num_lines), folder, progress)
            rows.append(row)
            found += [(one["confidence"], _is_right(one)) for one in answers if one["found"]]
    table = Table("Relocalization in large maps (simulated)", COLUMNS, rows, NOTES)
    write_tables(out, "relocalize", [table, reliability(found)], command)
    return table


def _town(bench: RelocalizeBench, town: int, progress: Progress) -> LineMap:
    return map_town(
        bench.road,
        bench.seed + town,
        bench.sensor,
        bench.config,
        lambda: progress(f"town {town}", 1),
    )


def _queries(bench: RelocalizeBench, folder: Path, seed: int, town: int) -> list[Query]:
    return write_queries(folder, bench.road, seed, town, bench.num_queries, bench.sensor)


def _measured(
    bench: RelocalizeBench,
    towns: list[LineMap],
    queries: list[Query],
    num_lines: int,
    folder: Path,
    progress: Progress,
) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Return a row of the table and the answers to all scans."""
    line_map, T_map_town = lay_out(towns, num_lines, bench.seed)
    path = folder / f"{num_lines}.sl3d"
    line_map.save(path)
    steps_m, again = street_steps(line_map.T_map_keyframe[:, :3, 3])
    head = {
        "lines": len(line_map),
        "street_km": float(steps_m[~again].sum()) / 1e3,
        "file_mb": path.stat().st_size / 1e6,
    }
    del line_map
    task = {
        "map": str(path),
        "config": bench.config.model_dump(),
        "queries": [_plain(query, T_map_town) for query in queries],
    }
    work = folder / f"run_{num_lines}"
    work.mkdir()
    end = run_runner(RUNNER, work, task, lambda steps: progress(f"{num_lines} lines", steps))
    path.unlink()
    if end.problem:
        return {**head, "status": end.problem}, []
    return {**head, **figures(end.answer), "status": "ok"}, end.answer["answers"]


def _plain(query: Query, T_map_town: list[Transform]) -> dict[str, Any]:
    placed = None if query.town < 0 else T_map_town[query.town].tolist()
    return {"path": str(query.path), "T_map_town": placed}


def figures(answer: dict[str, Any]) -> dict[str, Any]:
    """Count and average what a process found."""
    inside = [one for one in answer["answers"] if one["inside"]]
    outside = [one for one in answer["answers"] if not one["inside"]]
    found = [one for one in inside if one["found"]]
    right = [one for one in found if _is_right(one)]
    row = {key: value for key, value in answer.items() if key != "answers"}
    for key in ("retrieval", "latency"):
        taken = np.array([one[f"{key}_ms"] for one in answer["answers"]])
        row[f"{key}_ms"] = float(taken.mean())
        row[f"{key}_p99_ms"] = float(np.percentile(taken, 99))
    return {
        **row,
        "asked": len(inside),
        "right": len(right),
        "wrong": len(found) - len(right),
        "median_m": float(np.median([one["error_m"] for one in right])) if right else None,
        "outside": len(outside),
        "placed": sum(one["found"] for one in outside),
    }


def _is_right(answer: dict[str, Any]) -> bool:
    inside: bool = answer["inside"]
    return inside and answer["error_m"] < RIGHT_M and answer["error_deg"] < RIGHT_DEG

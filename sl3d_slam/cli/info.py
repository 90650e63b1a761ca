"""``sl3d info``: what is in a dataset or a line map, or what a run found."""

from json import dumps, loads
from pathlib import Path
from typing import Annotated, Any

import typer

from sl3d_slam.cli.map_facts import show_map
from sl3d_slam.cli.options import DatasetOption, JsonOption, SequenceOption, TopicOption
from sl3d_slam.errors import InputError

METRICS = "metrics.json"
MAP_SUFFIX = ".sl3d"


def info(
    data: Annotated[
        Path, typer.Argument(metavar="DATA|DIR|MAP", help="Scans, a run's folder, or a map.")
    ],
    dataset: DatasetOption = "auto",
    sequence: SequenceOption = None,
    topic: TopicOption = None,
    json: JsonOption = False,
) -> None:
    """Tell what a folder of scans or a map.sl3d holds, or show the figures of a run again."""
    if data.suffix == MAP_SUFFIX:
        show_map(data, json)
        return
    if (data / METRICS).is_file():
        _show_run(data, json)
        return
    facts = _describe(data, dataset, sequence, topic)
    if json:
        typer.echo(dumps(facts, indent=2))
        return
    for name, value in facts.items():
        typer.echo(f"{name.replace('_', ' ')}: {_plain(value)}")


def _show_run(folder: Path, as_json: bool) -> None:
    from rich.console import Console

    from sl3d_slam.report.summary import summary_table

    path = folder / METRICS
    try:
        metrics = loads(path.read_text(encoding="utf-8"))
        table = summary_table(metrics, str(folder))
    except (OSError, ValueError, RecursionError, AttributeError, TypeError, KeyError):
        raise InputError(f"{path}: expected the figures that sl3d map writes there") from None
    if as_json:
        typer.echo(dumps(metrics, indent=2))
    else:
        Console().print(table)


def _describe(path: Path, kind: str, sequence: str | None, topic: str | None) -> dict[str, Any]:
    from sl3d_slam.config import InputSettings
    from sl3d_slam.io.open import open_dataset

    dataset = open_dataset(path, InputSettings(), kind, sequence, topic)
    first = next(dataset.iterate(0, 1), None)
    return {
        "name": dataset.name,
        "description": dataset.description,
        "scans": dataset.num_scans,
        "points_in_the_first_scan": 0 if first is None else len(first.points_lidar),
        "times_of_points": first is not None and first.point_times_s is not None,
        "true_poses": dataset.truth is not None,
        "camera_calibration": dataset.T_cam_lidar is not None,
        "simulated": dataset.simulated,
        "warnings": list(dataset.warnings),
    }


def _plain(value: object) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, list):
        return "; ".join(value) or "none"
    return str(value)

"""``sl3d loops``: the loops of a drive, with precision and recall where the poses are known."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sl3d_slam.cli.options import (
    ConfigOption,
    DataArgument,
    DatasetOption,
    JsonOption,
    QuietOption,
    ScansOption,
    SequenceOption,
    SetOption,
    TopicOption,
    WorkersOption,
)

if TYPE_CHECKING:
    from jaxtyping import Float64
    from numpy import ndarray

    from sl3d_slam.types import LoopRecord


def loops(
    data: DataArgument,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE.json", help="Write every candidate.")
    ] = None,
    dataset: DatasetOption = "auto",
    sequence: SequenceOption = None,
    topic: TopicOption = None,
    scans: ScansOption = None,
    config: ConfigOption = None,
    overrides: SetOption = None,
    workers: WorkersOption = None,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Find the loops of a drive. Status 1 where there is none."""
    from sl3d_slam.cli.map import Mapping, drive_through
    from sl3d_slam.config import load_config
    from sl3d_slam.files import prove_writable
    from sl3d_slam.io.json_files import write_json
    from sl3d_slam.io.open import open_dataset
    from sl3d_slam.run import loop_tree

    settings = load_config(config, overrides or ())
    if out is not None:
        prove_writable(out)
    opened = open_dataset(data, settings.input, dataset, sequence, topic)
    run = drive_through(opened, Mapping(settings, scans, quiet or json, workers))
    found = run.loops
    if out is not None:
        write_json(out, [loop_tree(loop) for loop in found])
    figures = _figures(found, None if opened.truth is None else opened.truth[: len(run.trajectory)])
    if json:
        from json import dumps

        typer.echo(dumps(figures | {"loops": [loop_tree(loop) for loop in found]}))
    elif not quiet:
        for name, value in figures.items():
            shown = f"{value:.1f}" if isinstance(value, float) else value
            typer.echo(f"{name.replace('_', ' ')}: {shown}")
    if not any(loop.status == "accepted" for loop in found):
        raise typer.Exit(1)


def _figures(
    found: "list[LoopRecord]", truth: 'Float64[ndarray, "N 4 4"] | None'
) -> dict[str, Any]:
    """Count loops by status; with truth, also the false ones and precision and recall."""
    statuses = [loop.status for loop in found]
    figures: dict[str, Any] = {
        name: statuses.count(name) for name in ("accepted", "rejected", "revoked")
    }
    if truth is not None:
        from sl3d_slam.bench.loop_detectors import as_detection
        from sl3d_slam.bench.loop_figures import judge
        from sl3d_slam.bench.loop_revisits import find_revisits

        rows, _ = judge([as_detection(loop) for loop in found], truth, find_revisits(truth))
        figures |= {
            key: rows[0].get(key)
            for key in ("false", "num_revisits", "precision_percent", "recall_percent")
        }
    return figures

"""``sl3d map``: a whole sequence to poses, loops, graph, line map, numbers and pictures."""

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
)

if TYPE_CHECKING:
    from sl3d_slam.config import SlamConfig
    from sl3d_slam.io.dataset import Dataset
    from sl3d_slam.run import Run


def map_(
    data: DataArgument,
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Where to write the run.")],
    dataset: DatasetOption = "auto",
    sequence: SequenceOption = None,
    topic: TopicOption = None,
    scans: ScansOption = None,
    config: ConfigOption = None,
    overrides: SetOption = None,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Map a drive: KITTI odometry layout, a folder of scans, or a bag."""
    from sl3d_slam.config import load_config
    from sl3d_slam.files import prepare_run_folder
    from sl3d_slam.io.open import open_dataset

    settings = load_config(config, overrides or ())
    opened = open_dataset(data, settings.input, dataset, sequence, topic)
    prepare_run_folder(out)
    figures = run_map(opened, out, settings, scans, quiet)
    if json:
        from json import dumps

        typer.echo(dumps(figures))
    elif not quiet:
        from rich.console import Console

        from sl3d_slam.report.summary import summary_table

        kind = "simulated drive" if opened.simulated else "drive"
        Console().print(summary_table(figures, f"{kind} {opened.name} -> {out}"))


def run_map(
    opened: "Dataset", out: Path, settings: "SlamConfig", scans: int | None, quiet: bool
) -> dict[str, Any]:
    """Map an opened dataset into a run folder and return the metrics."""
    import time

    start_s = time.perf_counter()
    run = drive_through(opened, settings, scans, quiet)
    wall_s = time.perf_counter() - start_s
    rate = len(run.trajectory) / wall_s
    return run.save(out, opened, {"wall_s": wall_s, "scans_per_s": rate})


def drive_through(
    opened: "Dataset", settings: "SlamConfig", scans: int | None, quiet: bool
) -> "Run":
    """Take an opened dataset through the pipeline; say its warnings, show the progress."""
    from sl3d_slam.cli.progress import Meter
    from sl3d_slam.pipeline import SlamPipeline

    for warning in opened.warnings:
        typer.echo(f"sl3d: {warning}", err=True)
    slam = SlamPipeline(settings, simulated=opened.simulated)
    total = len(opened) if scans is None else min(scans, len(opened))
    with Meter(total, quiet=quiet) as meter:
        for scan in opened.iterate(0, total):
            slam.process(scan)
            meter.advance(f"loops {slam.num_loops}")
    return slam.finish()

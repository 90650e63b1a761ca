"""``sl3d map``: a whole sequence to poses, loops, graph, line map, numbers and pictures."""

from dataclasses import dataclass
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
    from sl3d_slam.config import SlamConfig
    from sl3d_slam.io.dataset import Dataset
    from sl3d_slam.journal import Journal
    from sl3d_slam.run import Run
    from sl3d_slam.types import WorldMeasurements


def map_(
    data: DataArgument,
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Where to write the run.")],
    dataset: DatasetOption = "auto",
    sequence: SequenceOption = None,
    topic: TopicOption = None,
    scans: ScansOption = None,
    config: ConfigOption = None,
    overrides: SetOption = None,
    resume: Annotated[
        bool,
        typer.Option("--resume", help="Continue an interrupted run in the same folder, if any."),
    ] = False,
    workers: WorkersOption = None,
    covariance: Annotated[
        bool, typer.Option("--covariance", help="Write the covariance of every keyframe's pose.")
    ] = False,
    gps: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Positions: TUM, or CSV with t,lat,lon,alt[,sigma]."),
    ] = None,
    attitude: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Gravity or IMU: CSV t,up_x,up_y,up_z or t,qx,..,qw."),
    ] = None,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Map a drive: KITTI odometry layout, a folder of scans, or a bag."""
    from sl3d_slam.config import load_config
    from sl3d_slam.files import prepare_run_folder
    from sl3d_slam.io.open import open_dataset
    from sl3d_slam.io.world_files import read_world
    from sl3d_slam.journal import open_journal

    settings = load_config(config, overrides or ())
    measurements = read_world(gps, attitude, settings.world)
    opened = open_dataset(data, settings.input, dataset, sequence, topic)
    prepare_run_folder(out)
    with open_journal(out, identity_of(opened, settings), resume) as journal:
        slam = Mapping(settings, scans, quiet, workers, journal, measurements, covariance)
        figures = run_map(opened, out, slam)
    if json:
        from json import dumps

        typer.echo(dumps(figures))
    elif not quiet:
        from rich.console import Console

        from sl3d_slam.report.summary import summary_table

        kind = "simulated drive" if opened.simulated else "drive"
        Console().print(summary_table(figures, f"{kind} {opened.name} -> {out}"))


@dataclass(frozen=True)
class Mapping:
    """How a drive is mapped; ``workers`` None is one where there is a processor for it."""

    settings: "SlamConfig"
    scans: int | None = None
    quiet: bool = False
    workers: int | None = None
    journal: "Journal | None" = None
    measurements: "WorldMeasurements | None" = None
    covariance: bool = False


def run_map(opened: "Dataset", out: Path, mapping: Mapping) -> dict[str, Any]:
    """Map an opened dataset into a run folder and return the metrics."""
    import time

    start_s = time.perf_counter()
    run = drive_through(opened, mapping)
    wall_s = time.perf_counter() - start_s
    rate = len(run.trajectory) / wall_s
    return run.save(out, opened, {"wall_s": wall_s, "scans_per_s": rate})


def drive_through(opened: "Dataset", mapping: Mapping) -> "Run":
    """Take an opened dataset through the pipeline; say its warnings, show the progress."""
    from contextlib import closing

    from sl3d_slam.beside import default_workers
    from sl3d_slam.cli.progress import COMPILING, Meter, notice
    from sl3d_slam.pipeline import SlamPipeline

    for warning in opened.warnings:
        typer.echo(f"sl3d: {warning}", err=True)
    workers = default_workers() if mapping.workers is None else mapping.workers
    total = len(opened) if mapping.scans is None else min(mapping.scans, len(opened))
    pipeline = SlamPipeline(mapping.settings, opened.simulated, workers, mapping.journal)
    with closing(pipeline) as slam, notice(COMPILING, lambda: not slam.is_ready, mapping.quiet):
        slam.get_ready()
        with Meter(total, quiet=mapping.quiet) as meter:
            for scan in opened.iterate(0, total):
                slam.process(scan)
                meter.advance(f"loops {slam.num_loops}")
        return slam.finish(mapping.measurements, mapping.covariance)


def identity_of(opened: "Dataset", settings: "SlamConfig") -> dict[str, str]:
    """Return what must be the same for an interrupted run to be continued."""
    from sl3d_slam import __version__
    from sl3d_slam.config import dump_config

    return {
        "input": opened.description,
        "config": dump_config(settings),
        "version of sl3d_slam": __version__,
    }

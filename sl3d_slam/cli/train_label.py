"""``sl3d train label``: the lines of a drive, labelled by a network that learns from its labels."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sl3d_slam.cli.options import DataArgument, DatasetOption, QuietOption, SequenceOption

if TYPE_CHECKING:
    from sl3d_slam.learning.label_rounds import RoundFigures


def label(
    data: DataArgument,
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Where labels go.")],
    rounds: Annotated[int, typer.Option(min=1, help="Vote, label, refine: how often.")] = 3,
    weights: Annotated[
        Path | None,
        typer.Option("--from", metavar="FILE", help="Weights of sl3d train synthetic."),
    ] = None,
    workers: Annotated[int, typer.Option(min=1, help="Processes.")] = 1,
    sequence: SequenceOption = None,
    dataset: DatasetOption = "auto",
    every: Annotated[int, typer.Option(min=1, help="Only each so-many-th scan.")] = 1,
    scans: Annotated[int | None, typer.Option(min=1, help="Only of the first so many.")] = None,
    views: Annotated[int, typer.Option(min=1, help="Random views that vote on a scan.")] = 10,
    steps: Annotated[int, typer.Option(min=1, help="Training steps between rounds.")] = 400,
    lying: Annotated[bool, typer.Option("--lying", help="Label lines that lie, too.")] = False,
    quiet: QuietOption = False,
) -> None:
    """Label the lines of a drive by geometric adaptation; what is done is not done again.

    Without --from a network is trained on synthetic shapes first, briefly.
    """
    from sl3d_slam.cli.progress import Meter
    from sl3d_slam.files import prepare_run_folder
    from sl3d_slam.learning.adaptation import AdaptationSettings
    from sl3d_slam.learning.label_rounds import LabelRun, run_rounds
    from sl3d_slam.learning.labelling import LabelSettings, Source
    from sl3d_slam.learning.refinement import RefineSettings

    source = Source(str(data), sequence, dataset)
    source.open()
    prepare_run_folder(out)
    run = LabelRun(
        source=source,
        weights=weights or _trained_on_shapes(out / "synthetic", quiet),
        rounds=rounds,
        workers=workers,
        every=every,
        scans=scans,
        settings=LabelSettings(lying=lying, adaptation=AdaptationSettings(views=views)),
        refinement=RefineSettings(steps=steps),
    )
    with Meter(run.num_steps(), "steps", quiet) as meter:
        figures = run_rounds(run, out, meter.advance)
    if not quiet:
        _show(figures, out)


def _trained_on_shapes(folder: Path, quiet: bool) -> Path:
    from sl3d_slam.cli.progress import Meter
    from sl3d_slam.learning.background import simulated_clips
    from sl3d_slam.learning.synthetic_training import SyntheticRun, train_synthetic

    path = folder / "weights.safetensors"
    if not path.is_file():
        run = SyntheticRun(clouds=2000, epochs=1)
        with Meter(run.steps, "steps", quiet) as meter:
            train_synthetic(run, simulated_clips(run.seed), folder, meter.advance)
    return path


def _show(figures: "list[RoundFigures]", out: Path) -> None:
    for row in figures:
        text = f"round {row.number}: {row.scans} scans, {row.lines_per_scan:.1f} lines a scan"
        text += f", {row.unknown_share:.0%} of the points not known"
        if row.score is not None:
            text += f"; precision {row.score.precision:.1%}, recall {row.score.recall:.1%}"
        typer.echo(text)
    typer.echo(f"labels in {out / 'labels'}, pictures in {out / 'pictures'}")

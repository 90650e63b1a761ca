"""``sl3d train synthetic``: the first segmentation, from corners and poles alone."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sl3d_slam.cli.options import QuietOption

if TYPE_CHECKING:
    from sl3d_slam.learning.background import Clip


def synthetic(
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Where results go.")],
    clouds: Annotated[int, typer.Option(min=1, help="Different clouds of 5,000 points.")] = 5000,
    epochs: Annotated[int, typer.Option(min=1, help="How often each is seen.")] = 5,
    batch: Annotated[int, typer.Option(min=1, help="Clouds in a step.")] = 8,
    learning_rate: Annotated[float, typer.Option(help="Adam's, before it is halved.")] = 1e-3,
    width: Annotated[int, typer.Option(min=4, max=256, help="Channels of a block.")] = 64,
    neighbours: Annotated[int, typer.Option(min=2, max=64, help="Neighbours of a point.")] = 20,
    seed: Annotated[int, typer.Option(min=0, help="Of clouds, order and first weights.")] = 0,
    background: Annotated[
        list[Path] | None,
        typer.Option(metavar="SCAN", help="Cut clips from this scan; may be repeated."),
    ] = None,
    quiet: QuietOption = False,
) -> None:
    """Train the scale-invariant segmentation; a killed run goes on where it was.

    Clips beside the shapes come from a simulated street unless scans are given.
    """
    from sl3d_slam.cli.progress import Meter
    from sl3d_slam.files import prepare_run_folder
    from sl3d_slam.learning.synthetic_training import (
        SyntheticRun,
        scale_invariant,
        train_synthetic,
    )

    prepare_run_folder(out)
    run = SyntheticRun(
        seed=seed,
        clouds=clouds,
        epochs=epochs,
        batch=batch,
        learning_rate=learning_rate,
        network=scale_invariant(width, neighbours),
    )
    with Meter(run.steps, "steps", quiet) as meter:
        figures = train_synthetic(run, _clips(seed, background), out, meter.advance)
    if not quiet:
        typer.echo(", ".join(f"{name} {value:.3f}" for name, value in figures.items()))
        typer.echo(f"weights in {out / 'weights.safetensors'}")


def _clips(seed: int, background: list[Path] | None) -> "tuple[Clip, ...]":
    from sl3d_slam.config import InputSettings
    from sl3d_slam.io.open import read_scan
    from sl3d_slam.learning.background import clips_of_scans, simulated_clips

    if not background:
        return simulated_clips(seed)
    return clips_of_scans([read_scan(path, InputSettings()) for path in background], seed)

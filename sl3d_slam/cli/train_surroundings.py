"""``sl3d train surroundings``: descriptors that hear of the lines around a line."""

from pathlib import Path
from typing import Annotated

import typer

from sl3d_slam.cli.options import QuietOption


def surroundings(
    weights: Annotated[
        Path, typer.Argument(metavar="WEIGHTS", help="Of sl3d train joint or calibrate.")
    ],
    data: Annotated[
        list[Path], typer.Argument(metavar="DATA...", help="Drives, real and simulated.")
    ],
    out: Annotated[Path, typer.Option("--out", metavar="FILE", help="The weights to write.")],
    steps: Annotated[int, typer.Option(min=1, help="Of six pairs of scans each.")] = 3000,
    seed: Annotated[int, typer.Option(min=0, help="Of the layer, pairs and changes.")] = 0,
    every: Annotated[int, typer.Option(min=1, help="Take every so many-th scan.")] = 2,
    quiet: QuietOption = False,
) -> None:
    """Find the lines of drives and learn to tell them apart by the lines around them.

    One layer is added; points and lines are found as before. Two lines are the same where the
    poses of the drive, true or of this package's odometry, bring them together.
    """
    from sl3d_slam.cli.progress import Meter
    from sl3d_slam.files import prove_writable
    from sl3d_slam.learning.line_drives import find_lines, line_extractor
    from sl3d_slam.learning.surroundings import SurroundingsSettings, learn_surroundings
    from sl3d_slam.lines.network.weights_file import load_weights, read_about, save_weights

    prove_writable(out)
    extractor, model = line_extractor(weights), load_weights(weights)
    with Meter(None, "scans read", quiet) as meter:
        drives = [find_lines(folder, extractor, every, meter.advance) for folder in data]
    settings = SurroundingsSettings(steps=steps, seed=seed)
    with Meter(steps, "steps", quiet) as meter:
        taught = learn_surroundings(model, drives, settings, meter.advance)
    about = read_about(weights)
    kept = {key.removeprefix("about."): about[key] for key in about if key.startswith("about.")}
    names = ", ".join(drive.name for drive in drives)
    save_weights(out, taught, kept | {"surroundings": f"{steps} steps, seed {seed}, on {names}"})
    if not quiet:
        typer.echo(f"weights in {out}")

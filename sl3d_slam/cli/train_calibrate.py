"""``sl3d train calibrate``: line probabilities that can be read as odds."""

from pathlib import Path
from typing import Annotated

import typer

from sl3d_slam.cli.options import QuietOption


def calibrate(
    weights: Annotated[Path, typer.Argument(metavar="WEIGHTS", help="Of sl3d train joint.")],
    data: Annotated[
        list[Path], typer.Argument(metavar="DATA...", help="Drives that it did not learn from.")
    ],
    out: Annotated[Path, typer.Option("--out", metavar="FILE", help="The weights to write.")],
    labels: Annotated[
        list[Path] | None,
        typer.Option(metavar="DIR", help="Labels of `sl3d train label`; may be repeated."),
    ] = None,
    cache: Annotated[Path, typer.Option(metavar="DIR", help="Keep prepared drives here.")] = Path(
        "prepared"
    ),
    quiet: QuietOption = False,
) -> None:
    """Fit the probabilities of a trained network to labelled drives; descriptors stay."""
    from sl3d_slam.cli.progress import Meter
    from sl3d_slam.files import prepare_run_folder, prove_writable
    from sl3d_slam.learning.calibration import calibrate as fit
    from sl3d_slam.learning.prepare import find_sources, prepare_drive
    from sl3d_slam.lines.network.weights_file import load_weights, read_about, save_weights

    prove_writable(out)
    prepare_run_folder(cache)
    model = load_weights(weights)
    with Meter(None, "scans prepared", quiet) as meter:
        drives = [
            prepare_drive(source, cache, model.settings, meter.advance)
            for source in find_sources(data, labels or ())
        ]
    found = fit(model, drives)
    about = read_about(weights)
    kept = {key.removeprefix("about."): about[key] for key in about if key.startswith("about.")}
    names = ", ".join(drive.name for drive in drives)
    told = f"slope {found.slope:.4f}, shift {found.shift:.4f}, on {names}"
    save_weights(out, model, kept | {"calibrated": told})
    if not quiet:
        errors = f"{found.error_before:.1%} before, {found.error_after:.1%} after"
        typer.echo(f"{told}; probabilities off by {errors}")
        typer.echo(f"weights in {out}")

"""``sl3d train joint``: segmentation and descriptors of lines, learned together from drives."""

from pathlib import Path
from typing import Annotated

import typer

from sl3d_slam.cli.options import QuietOption


def joint(
    data: Annotated[
        list[Path], typer.Argument(metavar="DATA...", help="Drives, real and simulated.")
    ],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Where results go.")],
    quiet: QuietOption = False,
) -> None:
    """Train segmentation and descriptors on pairs of scans of real and simulated drives."""
    raise NotImplementedError

"""``sl3d train towns``: the simulated drives that the shipped weights learned from."""

from pathlib import Path
from typing import Annotated

import typer

from sl3d_slam.cli.options import QuietOption


def towns(
    trajectories: Annotated[
        Path,
        typer.Argument(metavar="POSES", help="Folder of KITTI odometry pose files, 00.txt etc."),
    ],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Where the towns go.")],
    quiet: QuietOption = False,
) -> None:
    """Simulate the 25 towns of the shipped weights, and 40, which is held out."""
    from sl3d_slam.cli.progress import Meter
    from sl3d_slam.learning.towns import HELD_OUT, TOWNS, simulate_towns

    total = sum(plan.scans for plan in (*TOWNS, HELD_OUT))
    with Meter(total, "scans", quiet) as meter:
        folders = simulate_towns(trajectories, out, progress=meter.advance)
    if not quiet:
        typer.echo(f"{len(folders)} towns in {out / 'sequences'}")

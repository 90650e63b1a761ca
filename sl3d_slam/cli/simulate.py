"""``sl3d simulate``: a ray-cast drive through a town, in KITTI layout."""

from pathlib import Path
from typing import Annotated

import typer

from sl3d_slam.cli.options import QuietOption
from sl3d_slam.errors import InputError


def simulate(
    directory: Annotated[Path, typer.Argument(metavar="DIR", help="Where to write the sequence.")],
    trajectory: Annotated[
        Path | None, typer.Option(help="Build the town along this KITTI trajectory.")
    ] = None,
    road: Annotated[str, typer.Option(help="Built-in road: loop, street, outback, demo.")] = "loop",
    sensor: Annotated[str, typer.Option(help="hdl64, hdl32 or os1-128.")] = "hdl64",
    seed: Annotated[int, typer.Option(min=0, help="Another seed, another town.")] = 0,
    day: Annotated[int, typer.Option(min=0, help="Another day, other traffic.")] = 0,
    direction: Annotated[str, typer.Option(help="forward, reverse or half.")] = "forward",
    scans: Annotated[int | None, typer.Option(min=1, help="At most so many scans.")] = None,
    sequence: Annotated[str, typer.Option(help="Number of the sequence.")] = "00",
    truth: Annotated[bool, typer.Option(help="Write true lines and labels too.")] = True,
    quiet: QuietOption = False,
) -> None:
    """Simulate a street drive in KITTI layout, with true poses and lines."""
    from sl3d_slam.cli.progress import Meter
    from sl3d_slam.simulation.drive import DIRECTIONS, plan_drive
    from sl3d_slam.simulation.roads import builtin_road, read_road
    from sl3d_slam.simulation.sensor import sensor_named
    from sl3d_slam.simulation.town import build_town
    from sl3d_slam.simulation.write import Layout, refuse_existing, write_drive

    layout = Layout(directory, sequence, truth)
    refuse_existing(layout)
    if direction not in DIRECTIONS:
        raise InputError(f"--direction {direction}: expected one of {', '.join(DIRECTIONS)}")
    sensor_named(sensor)
    chosen = builtin_road(road) if trajectory is None else read_road(trajectory)
    drive = plan_drive(build_town(chosen, seed), sensor, day, direction, scans)
    with Meter(len(drive), quiet=quiet) as meter:
        folder = write_drive(drive, layout, meter.advance)
    if not quiet:
        typer.echo(f"{len(drive)} simulated scans in {folder}")

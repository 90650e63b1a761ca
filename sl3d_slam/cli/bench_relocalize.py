"""``sl3d bench relocalize``: scans in maps of ten thousand to a million lines."""

from typing import Annotated

import typer

from sl3d_slam.cli.bench_options import OutOption, SeedOption, command, numbers, show
from sl3d_slam.cli.options import ConfigOption, QuietOption, SetOption


def relocalize(
    out: OutOption,
    lines: Annotated[
        str, typer.Option(help="Landmarks of each map, comma-separated.")
    ] = "10000,100000,1000000",
    towns: Annotated[int, typer.Option(min=1, help="Towns that are asked for.")] = 3,
    queries: Annotated[int, typer.Option(min=2, help="Scans of each town, and outside.")] = 40,
    road: Annotated[str, typer.Option(help="Built-in road: demo, street, loop.")] = "demo",
    sensor: Annotated[str, typer.Option(help="hdl64, hdl32 or os1-128.")] = "hdl64",
    seed: SeedOption = 300,
    config: ConfigOption = None,
    overrides: SetOption = None,
    quiet: QuietOption = False,
) -> None:
    """Find scans of another day in ever larger maps: time, memory, success; simulated."""
    from sl3d_slam.bench.relocalize import RelocalizeBench, run
    from sl3d_slam.cli.progress import Meter
    from sl3d_slam.config import load_config

    sizes = [int(size) for size in numbers("--lines", lines)]
    settings = load_config(config, overrides or ())
    what = RelocalizeBench(sizes, towns, queries, seed, road, sensor, settings)
    with Meter(None, "steps", quiet) as meter:
        table = run(what, out, command(), meter.advance)
    show([table], out, quiet)

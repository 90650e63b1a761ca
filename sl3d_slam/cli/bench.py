"""``sl3d bench NAME``: this package beside its peers, measured in one run on one machine."""

import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sl3d_slam.cli.errors import Verbs
from sl3d_slam.cli.options import ConfigOption, DatasetOption, QuietOption, ScansOption, SetOption

if TYPE_CHECKING:
    from collections.abc import Sequence

    from sl3d_slam.bench.tables import Table

bench = typer.Typer(
    cls=Verbs,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="Compare this package with its peers; tables and pictures in --out.",
)

DataArguments = Annotated[
    list[Path], typer.Argument(metavar="DATA...", help="Drives: KITTI roots, folders, bags.")
]
OutOption = Annotated[Path, typer.Option("--out", metavar="DIR", help="Where results go.")]
SequencesOption = Annotated[
    list[str] | None,
    typer.Option("--sequence", metavar="NN", help="KITTI sequence; may be repeated."),
]


@bench.command("slam")
def slam(
    data: DataArguments,
    out: OutOption,
    dataset: DatasetOption = "auto",
    sequences: SequencesOption = None,
    scans: ScansOption = None,
    peers: Annotated[str, typer.Option(help="Comma-separated.")] = "kiss-slam,kiss-icp",
    out_and_back: Annotated[
        bool, typer.Option("--out-and-back", help="Turn one-way drives into revisits.")
    ] = False,
    config: ConfigOption = None,
    overrides: SetOption = None,
    quiet: QuietOption = False,
) -> None:
    """Whole drives against kiss-slam and KISS-ICP: accuracy, loops, time, memory."""
    from sl3d_slam.bench.slam import Drive, SlamBench, num_steps, run
    from sl3d_slam.cli.progress import Meter
    from sl3d_slam.config import load_config

    drives = [Drive(path, name, dataset) for path in data for name in sequences or (None,)]
    what = SlamBench(
        drives, _names(peers), scans, out_and_back, load_config(config, overrides or ())
    )
    with Meter(num_steps(what), quiet=quiet) as meter:
        table = run(what, out, _command(), meter.advance)
    _show([table], out, quiet)


def _names(text: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in text.split(",") if name.strip())


def _command() -> str:
    return shlex.join(["sl3d", *sys.argv[1:]])


def _show(tables: "Sequence[Table]", out: Path, quiet: bool) -> None:
    if quiet:
        return
    from rich.console import Console

    from sl3d_slam.bench.tables import to_rich

    console = Console()
    for table in tables:
        console.print(to_rich(table, console.width))
    typer.echo(f"results in {out}")

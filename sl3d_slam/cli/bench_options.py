"""What the verbs of ``sl3d bench`` share: options, drives, the table at the end."""

import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from collections.abc import Sequence

    from sl3d_slam.bench.drives import Drive
    from sl3d_slam.bench.tables import Table

DataArguments = Annotated[
    list[Path], typer.Argument(metavar="DATA...", help="Drives: KITTI roots, folders, bags.")
]
OutOption = Annotated[Path, typer.Option("--out", metavar="DIR", help="Where results go.")]
SequencesOption = Annotated[
    list[str] | None,
    typer.Option("--sequence", metavar="NN", help="KITTI sequence; may be repeated."),
]
OutAndBackOption = Annotated[
    bool, typer.Option("--out-and-back", help="Turn one-way drives into ones that come back.")
]
PeersOption = Annotated[str, typer.Option(help="Comma-separated.")]
SeedOption = Annotated[int, typer.Option(min=0, help="Chooses pairs and turns.")]
TruthOption = Annotated[str, typer.Option(help="given, or odometry where GPS is off.")]
DistancesOption = Annotated[str, typer.Option(help="Metres, comma-separated.")]


def drives_of(
    data: "Sequence[Path]",
    sequences: "Sequence[str] | None",
    dataset: str,
    scans: int | None = None,
    out_and_back: bool = False,
) -> "list[Drive]":
    """Return every sequence named of every dataset named, or the only one of each."""
    from sl3d_slam.bench.drives import Drive

    return [
        Drive(str(path.resolve()), name, dataset, scans, out_and_back)
        for path in data
        for name in sequences or (None,)
    ]


def numbers(option: str, text: str) -> tuple[float, ...]:
    """Return numbers above zero from a text with commas. Raises InputError."""
    from sl3d_slam.errors import InputError

    try:
        found = tuple(float(word) for word in names(text))
    except ValueError:
        raise InputError(f"{option} {text}: expected numbers with commas between") from None
    if any(not 0.0 < number < float("inf") for number in found):
        raise InputError(f"{option} {text}: expected numbers above zero")
    return found


def names(text: str) -> tuple[str, ...]:
    """Return the words of a text with commas."""
    return tuple(name.strip() for name in text.split(",") if name.strip())


def command() -> str:
    """Return the command line as it was typed, for the record."""
    return shlex.join(["sl3d", *sys.argv[1:]])


def show(tables: "Sequence[Table]", out: Path, quiet: bool) -> None:
    """Print the tables and where they are, unless quiet."""
    if quiet:
        return
    from rich.console import Console

    from sl3d_slam.bench.tables import to_rich

    console = Console()
    for table in tables:
        console.print(to_rich(table, console.width))
    typer.echo(f"results in {out}")

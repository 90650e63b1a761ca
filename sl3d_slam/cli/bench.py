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


@bench.command("registration")
def registration(
    data: DataArguments,
    out: OutOption,
    dataset: DatasetOption = "auto",
    sequences: SequencesOption = None,
    distances: Annotated[str, typer.Option(help="Metres, comma-separated.")] = "10,20,30,40",
    pairs: Annotated[int, typer.Option(min=1, help="Pairs for each distance.")] = 200,
    seed: Annotated[int, typer.Option(min=0, help="Chooses pairs and turns.")] = 0,
    peers: Annotated[
        str, typer.Option(help="Comma-separated.")
    ] = "kiss-matcher,fpfh-ransac,fgr,icp",
    pair_list: Annotated[
        Path | None, typer.Option(metavar="FILE", help="A public list of pairs instead.")
    ] = None,
    truth: Annotated[str, typer.Option(help="given, or odometry where GPS is off.")] = "given",
    different: Annotated[
        Path | None, typer.Option(metavar="DATA", help="A drive through other places.")
    ] = None,
    tilt: Annotated[float, typer.Option(min=0, max=45, help="Degrees of roll and pitch.")] = 0.0,
    ransac_iterations: Annotated[
        str, typer.Option(help="Iterations for a curve of RANSAC, comma-separated.")
    ] = "",
    config: ConfigOption = None,
    overrides: SetOption = None,
    quiet: QuietOption = False,
) -> None:
    """Two scans some distance apart, no first guess, against KISS-Matcher and Open3D."""
    from sl3d_slam.bench.registration import run
    from sl3d_slam.bench.registration_plan import RegistrationBench, make_plan
    from sl3d_slam.cli.progress import Meter
    from sl3d_slam.config import load_config

    what = RegistrationBench(
        drives=[(str(path), dataset, name) for path in data for name in sequences or (None,)],
        distances_m=_numbers("--distances", distances),
        num_pairs=pairs,
        seed=seed,
        peers=_names(peers),
        pair_list=pair_list,
        different=None if different is None else (str(different), "auto", None),
        truth=truth,
        tilt_deg=tilt,
        iterations=[int(n) for n in _numbers("--ransac-iterations", ransac_iterations)],
        config=load_config(config, overrides or ()),
    )
    plan = make_plan(what)
    with Meter(plan.num_pairs() * len(what.methods), "pairs", quiet) as meter:
        table = run(what, plan, out, _command(), meter.advance)
    _show([table], out, quiet)


def _numbers(option: str, text: str) -> tuple[float, ...]:
    from sl3d_slam.errors import InputError

    try:
        numbers = tuple(float(word) for word in _names(text))
    except ValueError:
        raise InputError(f"{option} {text}: expected numbers with commas between") from None
    if any(not 0.0 < number < float("inf") for number in numbers):
        raise InputError(f"{option} {text}: expected numbers above zero")
    return numbers


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

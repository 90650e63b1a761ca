"""The verbs of ``sl3d bench`` that take whole drives: slam, loops, growth, covariance."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sl3d_slam.cli.bench_options import (
    DataArguments,
    OutAndBackOption,
    OutOption,
    PeersOption,
    SequencesOption,
    command,
    drives_of,
    names,
    numbers,
    show,
)
from sl3d_slam.cli.options import (
    ConfigOption,
    DatasetOption,
    QuietOption,
    ScansOption,
    SequenceOption,
    SetOption,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from sl3d_slam.bench.tables import Table


def _comparison(
    load_run: "Callable[[], Callable[..., Table]]", usual_peers: str, what_it_does: str
) -> "Callable[..., None]":
    """Return a verb that takes whole drives through this package and its peers.

    ``load_run`` imports the benchmark, whose modules are heavy, when the verb is called.
    """

    def compare(
        data: DataArguments,
        out: OutOption,
        dataset: DatasetOption = "auto",
        sequences: SequencesOption = None,
        scans: ScansOption = None,
        peers: PeersOption = usual_peers,
        out_and_back: OutAndBackOption = False,
        config: ConfigOption = None,
        overrides: SetOption = None,
        quiet: QuietOption = False,
    ) -> None:
        from sl3d_slam.bench.drives import Comparison
        from sl3d_slam.cli.progress import Meter
        from sl3d_slam.config import load_config

        drives = drives_of(data, sequences, dataset, scans, out_and_back)
        what = Comparison(drives, names(peers), load_config(config, overrides or ()))
        with Meter(what.num_steps(), quiet=quiet) as meter:
            table = load_run()(what, out, command(), meter.advance)
        show([table], out, quiet)

    compare.__doc__ = what_it_does
    return compare


def _slam() -> "Callable[..., Table]":
    from sl3d_slam.bench.slam import run

    return run


def _loops() -> "Callable[..., Table]":
    from sl3d_slam.bench.loops import run

    return run


slam = _comparison(
    _slam,
    "kiss-slam,kiss-icp",
    "Whole drives against kiss-slam and KISS-ICP: accuracy, loops, time, memory.",
)
loops = _comparison(
    _loops,
    "map-closures",
    "Precision and recall of loops, same direction and reverse, against MapClosures.",
)


def growth(
    data: Annotated[Path, typer.Argument(metavar="DATA", help="A long drive.")],
    out: OutOption,
    dataset: DatasetOption = "auto",
    sequence: SequenceOption = None,
    lengths: Annotated[str, typer.Option(help="Scans, comma-separated.")] = "1000,2000,4541",
    config: ConfigOption = None,
    overrides: SetOption = None,
    quiet: QuietOption = False,
) -> None:
    """Time per scan and memory as a map grows: one drive mapped to several lengths."""
    from sl3d_slam.bench.drives import Drive
    from sl3d_slam.bench.growth import GrowthBench, run
    from sl3d_slam.cli.progress import Meter
    from sl3d_slam.config import load_config

    drive = Drive(str(data.resolve()), sequence, dataset)
    counts = [int(length) for length in numbers("--lengths", lengths)]
    what = GrowthBench(drive, counts, load_config(config, overrides or ()))
    with Meter(what.num_steps(), quiet=quiet) as meter:
        table = run(what, out, command(), meter.advance)
    show([table], out, quiet)


def covariance(
    data: DataArguments,
    out: OutOption,
    dataset: DatasetOption = "auto",
    sequences: SequencesOption = None,
    scans: ScansOption = None,
    pairs: Annotated[int, typer.Option(min=1, help="Pairs of views of each drive.")] = 150,
    min_travel: Annotated[
        float, typer.Option(min=0, help="Metres of way between the views of a pair.")
    ] = 40.0,
    seed: Annotated[int, typer.Option(min=0, help="Chooses pairs and first guesses.")] = 0,
    config: ConfigOption = None,
    overrides: SetOption = None,
    quiet: QuietOption = False,
) -> None:
    """Normalised errors of loops and odometry steps against true poses: honest is six."""
    from sl3d_slam.bench.covariance import CovarianceBench, run
    from sl3d_slam.cli.progress import Meter
    from sl3d_slam.config import load_config

    drives = drives_of(data, sequences, dataset, scans)
    what = CovarianceBench(drives, load_config(config, overrides or ()), pairs, min_travel, seed)
    with Meter(None, quiet=quiet) as meter:
        table = run(what, out, command(), meter.advance)
    show([table], out, quiet)

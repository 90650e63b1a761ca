"""``sl3d bench NAME``: this package beside its peers, measured in one run on one machine."""

from pathlib import Path
from typing import Annotated

import typer

from sl3d_slam.cli.bench_drives import covariance, growth, loops, slam
from sl3d_slam.cli.bench_lines import ablations, extract, lines
from sl3d_slam.cli.bench_options import (
    DataArguments,
    DistancesOption,
    OutOption,
    PeersOption,
    SeedOption,
    SequencesOption,
    TruthOption,
    command,
    drives_of,
    names,
    numbers,
    show,
)
from sl3d_slam.cli.bench_relocalize import relocalize
from sl3d_slam.cli.errors import make_verbs
from sl3d_slam.cli.options import ConfigOption, DatasetOption, QuietOption, SetOption

bench = make_verbs(
    help="Compare this package with its peers; tables and pictures in --out.",
)
bench.command("lines")(lines)
bench.command("extract")(extract)
bench.command("ablations")(ablations)
bench.command("relocalize")(relocalize)
bench.command("slam")(slam)
bench.command("loops")(loops)
bench.command("growth")(growth)
bench.command("covariance")(covariance)


@bench.command("registration")
def registration(
    data: DataArguments,
    out: OutOption,
    dataset: DatasetOption = "auto",
    sequences: SequencesOption = None,
    distances: DistancesOption = "10,20,30,40",
    pairs: Annotated[int, typer.Option(min=1, help="Pairs for each distance.")] = 200,
    seed: SeedOption = 0,
    peers: PeersOption = "kiss-matcher,fpfh-ransac,fgr,icp",
    pair_list: Annotated[
        Path | None, typer.Option(metavar="FILE", help="A public list of pairs instead.")
    ] = None,
    truth: TruthOption = "given",
    peer_pairs: Annotated[
        int | None, typer.Option(min=1, help="Peers on the first so many of them only.")
    ] = None,
    different: Annotated[
        list[Path] | None,
        typer.Option(metavar="DATA", help="A drive through other places; may be repeated."),
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
    from sl3d_slam.bench.drives import Drive
    from sl3d_slam.bench.registration import run
    from sl3d_slam.bench.registration_plan import RegistrationBench, make_plan
    from sl3d_slam.cli.progress import Meter
    from sl3d_slam.config import load_config

    what = RegistrationBench(
        drives=drives_of(data, sequences, dataset),
        distances_m=numbers("--distances", distances),
        num_pairs=pairs,
        seed=seed,
        peers=names(peers),
        pair_list=pair_list,
        peer_pairs=peer_pairs,
        different=[Drive(str(path.resolve())) for path in different or ()],
        truth=truth,
        tilt_deg=tilt,
        iterations=[int(n) for n in numbers("--ransac-iterations", ransac_iterations)],
        config=load_config(config, overrides or ()),
    )
    plan = make_plan(what)
    with Meter(what.num_steps(plan), "pairs", quiet) as meter:
        table = run(what, plan, out, command(), meter.advance)
    show([table], out, quiet)


@bench.command("backend")
def backend(
    out: OutOption,
    quick: Annotated[
        bool, typer.Option("--quick", help="A minute instead of half an hour.")
    ] = False,
    trajectory: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Drive along this KITTI pose file.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of drift and loops.")] = 1,
    quiet: QuietOption = False,
) -> None:
    """Pose-graph back ends against false loops; simulated."""
    from sl3d_slam.bench.backend import FULL, QUICK, num_steps, run
    from sl3d_slam.cli.progress import Meter

    extent = QUICK if quick else FULL
    with Meter(num_steps(extent), "steps", quiet) as meter:
        tables = run(out, extent, trajectory, seed, command(), meter.advance)
    show(tables, out, quiet)


@bench.command("scale")
def scale(
    out: OutOption,
    quick: Annotated[
        bool, typer.Option("--quick", help="Small clouds and networks; minutes.")
    ] = False,
    seed: Annotated[int, typer.Option(min=0, help="Of shapes and first weights.")] = 0,
    quiet: QuietOption = False,
) -> None:
    """Line segmentation when the world is scaled: ours, DGCNN, PointNet, PointNet++; simulated."""
    from sl3d_slam.bench.scale import num_steps, run
    from sl3d_slam.cli.progress import Meter

    with Meter(num_steps(quick), "steps", quiet) as meter:
        tables = run(out, quick, seed, command(), meter.advance)
    show(tables, out, quiet)


@bench.command("all")
def everything(
    out: OutOption,
    quick: Annotated[bool, typer.Option("--quick", help="A small town; minutes.")] = False,
    seed: Annotated[int, typer.Option(min=0, help="Another seed, another town.")] = 0,
    quiet: QuietOption = False,
) -> None:
    """Run every benchmark once, on a drive simulated for it."""
    from sl3d_slam.bench.everything import run
    from sl3d_slam.cli.progress import Meter

    with Meter(None, "steps", quiet) as meter:
        tables = run(out, quick, seed, command(), meter.advance)
    show(tables, out, quiet)

"""``sl3d bench lines`` and ``sl3d bench extract``: line extractors side by side."""

from pathlib import Path
from typing import Annotated

import typer

from sl3d_slam.cli.bench_options import (
    DataArguments,
    DistancesOption,
    OutOption,
    SeedOption,
    SequencesOption,
    TruthOption,
    command,
    drives_of,
    names,
    numbers,
    show,
)
from sl3d_slam.cli.options import ConfigOption, DatasetOption, QuietOption, ScansOption, SetOption

QUICK_PAIRS, QUICK_REGISTERED, QUICK_DISTANCES = 6, 3, "10,20"
MethodsOption = Annotated[str, typer.Option(help="Of geometric, learned; comma-separated.")]
WeightsOption = Annotated[
    list[str] | None,
    typer.Option("--weights", metavar="[NAME=]FILE", help="A network; may be repeated."),
]


def lines(
    data: DataArguments,
    out: OutOption,
    dataset: DatasetOption = "auto",
    sequences: SequencesOption = None,
    methods: MethodsOption = "geometric,learned",
    weights: WeightsOption = None,
    distances: DistancesOption = "5,10,20,30",
    pairs: Annotated[int, typer.Option(min=1, help="Pairs for each distance and drive.")] = 30,
    registered: Annotated[
        int, typer.Option(min=0, help="Of those at 10 m and more, how many are registered.")
    ] = 10,
    truth: TruthOption = "given",
    seed: SeedOption = 0,
    quick: Annotated[bool, typer.Option("--quick", help="Few pairs, at 10 and 20 m.")] = False,
    config: ConfigOption = None,
    overrides: SetOption = None,
    quiet: QuietOption = False,
) -> None:
    """Line extractors: lines found again, descriptors, registration, true lines of towns."""
    from sl3d_slam.bench.lines import run
    from sl3d_slam.bench.lines_plan import LinesBench, make_methods
    from sl3d_slam.cli.progress import Meter
    from sl3d_slam.config import load_config

    what = LinesBench(
        drives=drives_of(data, sequences, dataset),
        methods=make_methods(names(methods), weights or ()),
        distances_m=numbers("--distances", QUICK_DISTANCES if quick else distances),
        num_pairs=QUICK_PAIRS if quick else pairs,
        num_registered=QUICK_REGISTERED if quick else registered,
        truth=truth,
        seed=seed,
        config=load_config(config, overrides or ()),
    )
    with Meter(None, "steps", quiet) as meter:
        tables = run(what, out, command(), meter.advance)
    show(tables, out, quiet)


def ablations(
    data: Annotated[
        list[Path], typer.Argument(metavar="DATA...", help="Drives to learn from: KITTI, folders.")
    ],
    held_out: Annotated[
        Path, typer.Option(metavar="DATA", help="Drive to measure on, never learned from.")
    ],
    out: OutOption,
    steps: Annotated[int, typer.Option(min=1, help="Pairs of scans each learns from.")] = 300,
    points: Annotated[int, typer.Option(min=50, help="At most so many a cloud.")] = 6000,
    cache: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Keep prepared drives here.")
    ] = None,
    seed: SeedOption = 0,
    quiet: QuietOption = False,
) -> None:
    """Short trainings with one thing changed: stride, length of descriptors, kind of neighbours."""
    from sl3d_slam.bench.ablations import VARIANTS, Ablations, run
    from sl3d_slam.cli.progress import Meter

    what = Ablations(tuple(data), held_out, steps, points, seed, cache)
    with Meter(steps * len(VARIANTS), "steps", quiet) as meter:
        table = run(what, out, command(), meter.advance)
    show([table], out, quiet)


def extract(
    data: Annotated[
        list[Path], typer.Argument(metavar="SCAN|DATA...", help="Scan files, or drives.")
    ],
    out: OutOption,
    dataset: DatasetOption = "auto",
    sequences: SequencesOption = None,
    scans: ScansOption = 50,
    methods: MethodsOption = "geometric,learned",
    weights: WeightsOption = None,
    config: ConfigOption = None,
    overrides: SetOption = None,
    quiet: QuietOption = False,
) -> None:
    """What extracting the lines of a scan costs, stage by stage, beside KISS-ICP."""
    from sl3d_slam.bench.extract import ExtractBench, run
    from sl3d_slam.bench.lines_plan import make_methods
    from sl3d_slam.cli.progress import Meter
    from sl3d_slam.config import load_config
    from sl3d_slam.io.folder import SUFFIXES

    files = [path for path in data if path.suffix.lower() in SUFFIXES]
    drives = [path for path in data if path not in files]
    what = ExtractBench(
        make_methods(names(methods), weights or ()),
        files,
        drives_of(drives, sequences, dataset, scans),
        load_config(config, overrides or ()),
    )
    with Meter(what.num_steps(), quiet=quiet) as meter:
        tables = run(what, out, command(), meter.advance)
    show(tables, out, quiet)

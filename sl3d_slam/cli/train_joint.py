"""``sl3d train joint``: segmentation and descriptors of lines, learned together from drives."""

import os
from pathlib import Path
from typing import Annotated

import typer

from sl3d_slam.cli.options import QuietOption


def joint(
    data: Annotated[
        list[Path],
        typer.Argument(metavar="DATA...", help="Drives, real and simulated: KITTI or folders."),
    ],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Where the run goes.")],
    labels: Annotated[
        list[Path] | None,
        typer.Option(metavar="DIR", help="Labels of `sl3d train label`; may be repeated."),
    ] = None,
    singles: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="DATA",
            help="Scans of unrelated places, labelled by --from (else by geometry); repeatable.",
        ),
    ] = None,
    held_out: Annotated[
        list[Path] | None,
        typer.Option(metavar="DATA", help="Drive to measure on, never trained on; repeatable."),
    ] = None,
    steps: Annotated[int, typer.Option(min=1, help="Pairs of scans to learn from.")] = 6500,
    seed: Annotated[int, typer.Option(min=0, help="Of weights, pairs and changes.")] = 0,
    start: Annotated[
        Path | None, typer.Option("--from", metavar="WEIGHTS", help="Start from these weights.")
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with a run.")] = False,
    points: Annotated[int, typer.Option(min=50, help="At most so many a cloud.")] = 12_000,
    rate: Annotated[float, typer.Option(help="Highest learning rate.")] = 2e-3,
    contrast: Annotated[
        float, typer.Option(min=0, help="Weight of the ranking loss; the paper has none.")
    ] = 1.0,
    discriminative: Annotated[
        float, typer.Option(min=0, help="Weight of the paper's four descriptor terms, 1 there.")
    ] = 0.0,
    real_share: Annotated[
        float, typer.Option(min=0, max=1, help="Share of pairs from real drives.")
    ] = 0.4,
    stride: Annotated[int, typer.Option(min=1, help="Of skip encoding; the paper's is 4.")] = 1,
    descriptor_dim: Annotated[int, typer.Option(min=2, help="Numbers a descriptor.")] = 64,
    neighbours: Annotated[str, typer.Option(help="Found in: space or features.")] = "space",
    checkpoint_every: Annotated[int, typer.Option(min=1, help="Steps.")] = 200,
    stop: Annotated[
        int | None, typer.Option(min=1, help="Leave the run at this step, to go on later.")
    ] = None,
    cache: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Keep prepared drives here.")
    ] = None,
    threads: Annotated[int, typer.Option(min=1, help="Of one process.")] = 1,
    quiet: QuietOption = False,
) -> None:
    """Train segmentation and descriptors on pairs of scans of real and simulated drives.

    Simulated drives bring their own labels; a real one takes those of --labels, or else lines that
    several of its scans confirm. Poses of real drives are this package's odometry. Start it with
    `torchrun --no-python sl3d train joint ...` to train in several processes.
    """
    from pydantic import ValidationError

    from sl3d_slam.cli.progress import Meter
    from sl3d_slam.errors import InputError
    from sl3d_slam.learning.joint_run import JointPlan, train_joint
    from sl3d_slam.learning.joint_settings import JointSettings, LossSettings
    from sl3d_slam.lines.network.settings import NetworkSettings

    quiet = quiet or os.environ.get("RANK", "0") != "0"  # of the processes of torchrun one speaks
    try:
        settings = JointSettings(
            steps=steps,
            seed=seed,
            points=points,
            learning_rate=rate,
            real_share=real_share,
            loss=LossSettings(contrast=contrast, discriminative=discriminative),
        )
        network = NetworkSettings.model_validate(
            {"stride": stride, "descriptor_dim": descriptor_dim, "neighbours": neighbours}
        )
    except ValidationError as error:
        problem = error.errors()[0]
        raise InputError(f"{problem['loc'][0]}: {problem['msg']}") from None
    plan = JointPlan(
        data=tuple(data),
        out=out,
        labels=tuple(labels or ()),
        singles=tuple(singles or ()),
        held_out=tuple(held_out or ()),
        start=start,
        resume=resume,
        cache=cache,
        checkpoint_every=checkpoint_every,
        stop=stop,
        threads=threads,
    )
    with Meter(None, "scans prepared", quiet) as reading, Meter(steps, "steps", quiet) as meter:
        train_joint(plan, settings, network, reading.advance, meter.advance)
    if not quiet:
        typer.echo(f"weights in {out / 'weights.safetensors'}")

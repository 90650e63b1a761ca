"""Options that several verbs share, so that they read the same everywhere."""

from pathlib import Path
from typing import Annotated

import typer

ConfigOption = Annotated[
    Path | None,
    typer.Option("--config", metavar="FILE", help="Settings that differ from the defaults (YAML)."),
]
SetOption = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Change one setting; may be repeated."),
]
QuietOption = Annotated[bool, typer.Option("--quiet", "-q", help="No progress bar, no table.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print the answer as JSON.")]
DataArgument = Annotated[
    Path,
    typer.Argument(metavar="DATA", help="KITTI root or sequence, folder of scans, or bag."),
]
DatasetOption = Annotated[
    str, typer.Option("--dataset", help="auto, kitti, generic, mcap or rosbag.")
]
SequenceOption = Annotated[
    str | None, typer.Option("--sequence", metavar="NN", help="Which KITTI sequence, such as 00.")
]
TopicOption = Annotated[
    str | None, typer.Option("--topic", help="Which PointCloud2 topic of a bag.")
]
ScansOption = Annotated[
    int | None, typer.Option("--scans", min=1, help="Only the first so many scans.")
]
WorkersOption = Annotated[
    int | None,
    typer.Option(
        "--workers",
        min=0,
        max=64,
        help="Processes that find lines and loops beside odometry; 0 for one after the other "
        "(default: one, where there is a processor for it). The results are the same.",
    ),
]

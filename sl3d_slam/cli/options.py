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

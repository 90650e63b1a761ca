"""The ``sl3d`` command: its verbs, one small file each.

A verb's file imports nothing but typer and the standard library at its top, so that
``sl3d --help`` answers at once; what the verb needs it imports when it runs.
"""

import os
from typing import Annotated

import typer

from sl3d_slam import __version__
from sl3d_slam.cli.bench import bench
from sl3d_slam.cli.config import config
from sl3d_slam.cli.demo import demo
from sl3d_slam.cli.errors import make_verbs
from sl3d_slam.cli.export import export
from sl3d_slam.cli.info import info
from sl3d_slam.cli.lines import lines
from sl3d_slam.cli.loops import loops
from sl3d_slam.cli.map import map_
from sl3d_slam.cli.merge import merge
from sl3d_slam.cli.register import register
from sl3d_slam.cli.relocalize import relocalize
from sl3d_slam.cli.simulate import simulate
from sl3d_slam.cli.train import train
from sl3d_slam.cli.view import view

app = make_verbs(
    add_completion=False,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)
app.command("map")(map_)
app.command()(loops)
app.command()(relocalize)
app.command()(register)
app.command()(lines)
app.command()(simulate)
app.command()(info)
app.command()(merge)
app.command()(export)
app.command()(view)
app.command()(config)
app.command()(demo)
app.add_typer(bench, name="bench")
app.add_typer(train, name="train")


def _print_version(wanted: bool) -> bool:
    if wanted:
        typer.echo(f"sl3d {__version__}")
        raise typer.Exit
    return wanted


@app.callback()
def _frame(
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Print the version."
        ),
    ] = False,
) -> None:
    """LiDAR SLAM with 3D lines: map a drive, close its loops, find yourself in a saved map.

    Exit status: 0 done; 1 done, but the answer is no; 2 wrong use or input.
    """


def main() -> None:
    """Run the command line.

    Matrices are small here: more threads of BLAS only wait for each other, by spinning. It reads
    the variable when numpy is first imported, after this.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    app(prog_name="sl3d")

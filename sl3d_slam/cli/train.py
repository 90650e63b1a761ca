"""``sl3d train NAME``: from made-up corners and raw drives to the weights of the line network."""

import typer

from sl3d_slam.cli.errors import Verbs
from sl3d_slam.cli.train_calibrate import calibrate
from sl3d_slam.cli.train_joint import joint
from sl3d_slam.cli.train_label import label
from sl3d_slam.cli.train_surroundings import surroundings
from sl3d_slam.cli.train_synthetic import synthetic
from sl3d_slam.cli.train_towns import towns

train = typer.Typer(
    cls=Verbs,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    help="Train the line network: synthetic shapes, automatic labels, then lines and descriptors.",
)
train.command("synthetic")(synthetic)
train.command("label")(label)
train.command("joint")(joint)
train.command("calibrate")(calibrate)
train.command("surroundings")(surroundings)
train.command("towns")(towns)

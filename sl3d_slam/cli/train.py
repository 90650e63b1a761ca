"""``sl3d train NAME``: from made-up corners and raw drives to the weights of the line network."""

from sl3d_slam.cli.errors import make_verbs
from sl3d_slam.cli.train_calibrate import calibrate
from sl3d_slam.cli.train_joint import joint
from sl3d_slam.cli.train_label import label
from sl3d_slam.cli.train_surroundings import surroundings
from sl3d_slam.cli.train_synthetic import synthetic
from sl3d_slam.cli.train_towns import towns

train = make_verbs(
    help="Train the line network: synthetic shapes, automatic labels, then lines and descriptors.",
)
train.command("synthetic")(synthetic)
train.command("label")(label)
train.command("joint")(joint)
train.command("calibrate")(calibrate)
train.command("surroundings")(surroundings)
train.command("towns")(towns)

"""The settings of one network; they travel in the header of its weights."""

from typing import Literal

from pydantic import Field

from sl3d_slam.config import Settings

LINE = 1  # of the two classes; 0 is the background


class NetworkSettings(Settings):
    """What a network looks like and what it wants to be fed.

    Of the ``stride * num_neighbours`` nearest points every ``stride``-th is kept (skip encoding).
    ``neighbours`` says whether they are found once in space or again per block in feature space.
    ``axes`` are those that neighbours' offsets are expressed in: the sensor's, or horizontal ones
    that each neighbourhood defines itself, which makes the network blind to the heading.
    ``scale_invariant`` is the first layer of the paper's synthetic stage (Eq. 1 and 3).
    ``context`` joins a wide view, cells of 2 m, to the heads. ``heights`` tells the first block how
    high a point is above the ground; not with ``scale_invariant``. ``surroundings`` adds a layer
    in which the mean descriptor of a line hears of the lines around it.
    """

    width: int = Field(default=64, ge=4, le=256)
    descriptor_dim: int = Field(default=64, ge=2, le=256)
    num_neighbours: int = Field(default=20, ge=2, le=64)
    stride: int = Field(default=4, ge=1, le=16)
    neighbours: Literal["space", "features"] = "space"
    axes: Literal["sensor", "own"] = "own"
    scale_invariant: bool = False
    context: bool = True
    heights: bool = True
    surroundings: bool = False
    voxel_size_m: float = Field(default=0.25, gt=0)
    max_points: int = Field(default=20_000, ge=50)

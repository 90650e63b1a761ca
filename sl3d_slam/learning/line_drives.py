"""The lines that a network finds along drives, and which of them two scans have in common."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int64

from sl3d_slam.config import InputSettings, LineSettings
from sl3d_slam.errors import InputError
from sl3d_slam.geometry.se3 import invert
from sl3d_slam.io.open import open_dataset
from sl3d_slam.learning.pairs import close_pairs, draw_pair, gaps_of, same_lines
from sl3d_slam.learning.prepare import poses_of
from sl3d_slam.lines.extract import LineExtractor
from sl3d_slam.lines.network.weights_format import read_weights
from sl3d_slam.types import LineSet

MAX_LINES = 100


@dataclass(frozen=True, slots=True, eq=False)
class LineDrive:
    """Lines (lidar frame) of some scans of a drive, with ``T_world_lidar`` (N, 4, 4) of each."""

    name: str
    simulated: bool
    T_world_lidar: Float64[np.ndarray, "N 4 4"]
    lines: tuple[LineSet, ...]


def line_extractor(weights: Path) -> LineExtractor:
    """Return an extractor whose descriptors are those of the points of each line alone.

    Raises
    ------
    InputError
        where the weights cannot be used or their descriptors hear of other lines already.
    """
    if read_weights(weights)[0].surroundings:
        raise InputError(
            f"{weights}: went through sl3d train surroundings before; expected weights of "
            "sl3d train joint or calibrate"
        )
    return LineExtractor(LineSettings(weights=str(weights), max_lines=MAX_LINES))


def find_lines(
    folder: Path, extractor: LineExtractor, every: int, progress: Callable[[str], None]
) -> LineDrive:
    """Find the lines of every so many-th scan of a drive. Raises InputError."""
    dataset = open_dataset(folder, InputSettings())
    T_world_lidar = poses_of(dataset)
    lines = []
    for index in range(0, len(T_world_lidar), every):
        (scan,) = dataset.iterate(index, index + 1)
        lines.append(extractor.extract(scan.points_lidar))
        progress(dataset.name)
    return LineDrive(dataset.name, dataset.simulated, T_world_lidar[::every], tuple(lines))


@dataclass(frozen=True, slots=True, eq=False)
class LinePair:
    """Two scans of a drive and the rows (first, second) of their lines that are the same."""

    first: LineSet
    second: LineSet
    matches: Int64[np.ndarray, "M 2"]


@dataclass(slots=True, eq=False)
class LinePairs:
    """Draws pairs of scans of one drive, near and far ones as often.

    Two lines are the same where they lie within ``match_m`` under the poses of the drive.
    """

    drive: LineDrive
    match_m: float
    max_distance_m: float
    _indices: Int64[np.ndarray, "P 2"] = field(init=False)
    _gaps_m: Float64[np.ndarray, "P"] = field(init=False)
    _known: dict[tuple[int, int], LinePair] = field(init=False, default_factory=dict)

    def __post_init__(self) -> None:
        """Find all pairs that are close enough."""
        places = self.drive.T_world_lidar
        self._indices = close_pairs(places, self.max_distance_m)
        self._gaps_m = gaps_of(places, self._indices)

    def __len__(self) -> int:
        """Return how many pairs there are."""
        return len(self._indices)

    def draw(self, rng: np.random.Generator) -> LinePair:
        """Return a pair at a distance drawn evenly."""
        wanted_m = rng.uniform(0.0, self.max_distance_m)
        chosen = draw_pair(self._indices, self._gaps_m, wanted_m, rng)
        if chosen not in self._known:
            self._known[chosen] = self._matched(*chosen)
        return self._known[chosen]

    def _matched(self, first: int, second: int) -> LinePair:
        lines, T = self.drive.lines, self.drive.T_world_lidar
        T_first_second = invert(T[first]) @ T[second]
        ends = lines[first].endpoints, lines[second].endpoints
        matches = same_lines(*ends, T_first_second, self.match_m)
        return LinePair(lines[first], lines[second], matches)

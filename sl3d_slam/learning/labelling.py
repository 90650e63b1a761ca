"""One scan of one round of labelling: votes, lines, files. Runs in any number of processes."""

import io
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32, Float64
from pydantic import Field

from sl3d_slam.config import InputSettings, Settings
from sl3d_slam.errors import InputError
from sl3d_slam.files import write_whole
from sl3d_slam.geometry.ground import heights_above_ground, up_direction
from sl3d_slam.geometry.se3 import Points
from sl3d_slam.geometry.segments import Segments, directions
from sl3d_slam.io.dataset import Dataset
from sl3d_slam.io.kitti import find_sequence
from sl3d_slam.io.open import open_dataset
from sl3d_slam.learning.adaptation import AdaptationSettings, line_votes
from sl3d_slam.learning.confirmation import ConfirmationSettings, seen_again
from sl3d_slam.learning.line_growth import GrowthSettings, grow_lines
from sl3d_slam.lines.network.model import SuperLine3D
from sl3d_slam.lines.network.weights_file import load_weights

EVERY_POINT = InputSettings(min_range_m=0.0, max_range_m=1e6)
MIN_RANGE_M = 1.5
STANDING_SINE = 0.8
MIN_TOP_M = 0.8


class LabelSettings(Settings):
    """How scans are labelled.

    Lines are grown from the points with at least the first of ``kept_votes``, then from those with
    the second, and so on: beside an edge the votes fall off by and by, so where the strictest still
    connect points the line is sharpest. Lines farther than 37 degrees from upright are doubtful
    unless ``lying``: kerbs and the feet of walls are seldom found again from elsewhere.
    """

    kept_votes: tuple[float, ...] = Field(
        default=(0.95, 0.9, 0.85, 0.8, 0.7, 0.6, 0.5, 0.4), min_length=1
    )
    lying: bool = False
    adaptation: AdaptationSettings = AdaptationSettings()
    growth: GrowthSettings = GrowthSettings()
    confirmation: ConfirmationSettings = ConfirmationSettings()


@dataclass(frozen=True, slots=True)
class Source:
    """The drive to label, in words that travel to other processes."""

    data: str
    sequence: str | None = None
    dataset: str = "auto"

    def open(self) -> Dataset:
        """Open it with every finite point of its scans. Raises InputError."""
        return open_dataset(Path(self.data), EVERY_POINT, self.dataset, self.sequence)

    def folder(self) -> Path:
        """Return where a simulated sequence keeps its truth. Raises InputError."""
        return find_sequence(Path(self.data), self.sequence)


@dataclass(frozen=True, slots=True, eq=False)
class Candidates:
    """What one scan shows by itself: votes of its points, lines grown from them (lidar frame)."""

    votes: Float32[np.ndarray, "n"]
    lines: Segments
    doubtful: Float64[np.ndarray, "U 2 3"]


def load_segmentation(path: Path) -> SuperLine3D:
    """Return a network that labels: one that wants coordinates alone.

    Raises
    ------
    InputError
        naming a file that is missing, damaged or holds another kind of network.
    """
    network = load_weights(path)
    if not network.settings.scale_invariant:
        raise InputError(
            f"{path}: its network is not scale-invariant; expected weights of sl3d train synthetic"
        )
    return network


def find_candidates(
    network: SuperLine3D, points_lidar: Points, settings: LabelSettings, seed: int
) -> Candidates:
    """Vote on the points of a scan and grow lines from those that many call so."""
    rng = np.random.default_rng([seed, len(points_lidar)])
    votes = np.zeros(len(points_lidar), np.float32)
    far = np.einsum("nd,nd->n", points_lidar, points_lidar) > MIN_RANGE_M**2
    neighbours = (network.settings.num_neighbours, network.settings.stride)
    votes[far] = line_votes(network, points_lidar[far], settings.adaptation, rng, neighbours)
    up = up_direction(points_lidar)
    lines, doubtful = np.zeros((0, 2, 3)), np.zeros((0, 2, 3))
    for least in settings.kept_votes:
        grown = grow_lines(points_lidar[votes >= least], settings.growth, seed)
        plausible = _stand_out(grown, points_lidar, up)
        if not settings.lying:
            plausible &= np.abs(directions(grown) @ up) > STANDING_SINE
        lines, doubtful = _joined(lines, grown[plausible]), _joined(doubtful, grown[~plausible])
    return Candidates(votes, lines, doubtful)


def _joined(known: Float64[np.ndarray, "_ 2 3"], grown: Float64[np.ndarray, "_ 2 3"]) -> np.ndarray:
    """Add to segments those that lie along none of them."""
    return np.concatenate([known, grown[~seen_again(grown, known, ConfirmationSettings())]])


def _stand_out(segments: Segments, points_lidar: Points, up: np.ndarray) -> np.ndarray:
    """Tell which segments reach higher than 0.8 m above the ground: rings on it do not."""
    ends = segments.reshape(-1, 3)
    heights = heights_above_ground(np.concatenate([points_lidar, ends]), up)[len(points_lidar) :]
    return heights.reshape(-1, 2).max(axis=1, initial=-np.inf) > MIN_TOP_M


def write_candidates(path: Path, candidates: Candidates) -> None:
    """Keep what a scan showed; votes to 1/255. Raises OutputError."""
    buffer = io.BytesIO()
    np.savez_compressed(
        buffer,
        votes=np.round(255 * candidates.votes).astype(np.uint8),
        lines=candidates.lines.astype(np.float32),
        doubtful=candidates.doubtful.astype(np.float32),
    )
    write_whole(path, buffer.getvalue())


def read_candidates(path: Path) -> Candidates:
    """Return what :func:`write_candidates` wrote. Raises InputError naming the file."""
    try:
        with np.load(path, allow_pickle=False) as file:
            votes = file["votes"].astype(np.float32) / 255
            lines, doubtful = file["lines"].astype(float), file["doubtful"].astype(float)
    except (OSError, KeyError, ValueError, EOFError, zipfile.BadZipFile):
        raise InputError(
            f"{path}: cannot be read; expected the votes of a round, remove it to vote again"
        ) from None
    return Candidates(votes, lines.reshape(-1, 2, 3), doubtful.reshape(-1, 2, 3))


class ScanWorker:
    """One process's part: a network and a dataset, opened once, then one scan after another."""

    def __init__(
        self, source: Source, weights: Path, folder: Path, settings: LabelSettings
    ) -> None:
        torch.set_num_threads(1)
        self._dataset = source.open()
        self._network = load_segmentation(weights)
        self._folder = folder
        self._settings = settings

    def vote(self, index: int) -> None:
        """Vote on a scan and write the result, unless it is there already."""
        path = self._folder / f"{index:06d}.npz"
        if path.is_file():
            return
        (scan,) = self._dataset.iterate(index, index + 1)
        candidates = find_candidates(self._network, scan.points_lidar, self._settings, index)
        write_candidates(path, candidates)

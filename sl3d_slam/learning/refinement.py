"""Between two rounds of labelling: the segmentation is trained on, on the labels it has made."""

from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

import numpy as np
from pydantic import Field

from sl3d_slam.config import Settings
from sl3d_slam.geometry.se3 import Points
from sl3d_slam.io.dataset import Dataset
from sl3d_slam.learning.adaptation import AdaptationSettings, moved_at_random, random_view
from sl3d_slam.learning.labelling import load_segmentation
from sl3d_slam.learning.labels import UNKNOWN, ScanLabels, read_labels
from sl3d_slam.learning.segmentation import Sample, kind_weights
from sl3d_slam.learning.segmentation_trainer import FitSettings, Progress, fit
from sl3d_slam.lines.network.weights_file import save_weights
from sl3d_slam.types import LineKind

NUM_WEIGHED = 20
SCANS_IN_MEMORY = 64


class RefineSettings(Settings):
    """How long the network is trained on the labels of a round; 15,000 points as in the paper."""

    seed: int = Field(default=0, ge=0)
    steps: int = Field(default=400, ge=1)
    batch: int = Field(default=2, ge=1)
    learning_rate: float = Field(default=5e-4, gt=0)
    views: AdaptationSettings = AdaptationSettings(max_points=15_000)


def refine(
    weights: Path,
    dataset: Dataset,
    indices: list[int],
    folder: Path,
    settings: RefineSettings,
    progress: Progress = lambda note, steps: None,
) -> Path:
    """Train on ``folder/labels`` into ``folder/weights.safetensors``; return that path.

    Each step sees other random views of other scans. Points that are not known do not count.
    A finished file is taken as it is, an unfinished run goes on from its checkpoint.

    Raises
    ------
    InputError
        naming weights, labels or a checkpoint that cannot be used.
    OutputError
        where the result cannot be written.
    """
    path = folder / "weights.safetensors"
    if path.is_file():
        progress("refined before", settings.steps)
        return path
    network = load_segmentation(weights)
    fitting = FitSettings(
        steps=settings.steps,
        learning_rate=settings.learning_rate,
        num_neighbours=network.settings.num_neighbours,
        stride=network.settings.stride,
        halvings=2,
    )
    samples_of = labelled_samples(dataset, indices, folder / "labels", settings)
    fit(network, samples_of, fitting, folder / "checkpoint.safetensors", progress)
    about = {"stage": "labels", "scans": str(len(indices)), "data": dataset.name}
    save_weights(path, network, about)
    return path


def labelled_samples(
    dataset: Dataset, indices: list[int], folder: Path, settings: RefineSettings
) -> Callable[[int], list[Sample]]:
    """Return what each step is trained on: random views of labelled scans."""

    @lru_cache(maxsize=SCANS_IN_MEMORY)
    def scan_of(index: int) -> tuple[Points, ScanLabels]:
        (scan,) = dataset.iterate(index, index + 1)
        labels = read_labels(folder / f"{index:06d}.npz", len(scan.points_lidar))
        return scan.points_lidar.astype(np.float32).astype(np.float64), labels

    some = np.random.default_rng([settings.seed, 7]).permutation(indices)[:NUM_WEIGHED]
    weights = kind_weights([_kinds(scan_of(int(index))[1].line_id) for index in some])

    def samples_of(step: int) -> list[Sample]:
        rng = np.random.default_rng([settings.seed, 8, step])
        chosen = rng.choice(indices, settings.batch)
        return [_view(*scan_of(int(index)), weights, settings.views, rng) for index in chosen]

    return samples_of


def _view(
    points_lidar: Points,
    labels: ScanLabels,
    weights: np.ndarray,
    settings: AdaptationSettings,
    rng: np.random.Generator,
) -> Sample:
    chosen = random_view(points_lidar, settings, rng)[0]
    line_id = labels.line_id[chosen]
    known = (line_id != UNKNOWN).astype(np.float32)
    return Sample(
        points=moved_at_random(points_lidar[chosen], settings, rng).astype(np.float32),
        on_line=line_id >= 0,
        weights=known * weights[np.where(line_id >= 0, int(LineKind.VERTICAL_EDGE), 0)],
    )


def _kinds(line_id: np.ndarray) -> np.ndarray:
    """Return kinds for the weights; whether a line is a pole or an edge, labels do not know."""
    known = line_id[line_id != UNKNOWN]
    return np.where(known >= 0, int(LineKind.VERTICAL_EDGE), 0).astype(np.uint8)

"""``sl3d train synthetic``: the segmentation that knows corners and poles, at any scale."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from pydantic import Field

from sl3d_slam.config import Settings
from sl3d_slam.files import prepare_run_folder
from sl3d_slam.io.json_files import write_json
from sl3d_slam.learning.background import Clip
from sl3d_slam.learning.segmentation import Agreement, Sample, kind_weights, line_shares
from sl3d_slam.learning.segmentation_trainer import FitSettings, Progress, fit
from sl3d_slam.learning.synthetic import SyntheticCloud, SyntheticSettings, synthetic_cloud
from sl3d_slam.lines.network.model import SuperLine3D
from sl3d_slam.lines.network.settings import NetworkSettings
from sl3d_slam.lines.network.weights_file import save_weights
from sl3d_slam.types import LineKind

FIRST_TEST_CLOUD = 10_000_000
NUM_TEST_CLOUDS = 40
NUM_WEIGHED = 64


def scale_invariant(width: int = 64, num_neighbours: int = 20) -> NetworkSettings:
    """Return the network of this stage: shape alone counts, not size, height or surroundings."""
    return NetworkSettings(
        width=width,
        num_neighbours=num_neighbours,
        scale_invariant=True,
        context=False,
        heights=False,
    )


class SyntheticRun(Settings):
    """A training run on synthetic clouds: ``epochs`` times the same ``clouds`` of a seed."""

    seed: int = Field(default=0, ge=0)
    clouds: int = Field(default=5000, ge=1)
    epochs: int = Field(default=5, ge=1)
    batch: int = Field(default=8, ge=1)
    learning_rate: float = Field(default=1e-3, gt=0)
    shapes: SyntheticSettings = SyntheticSettings()
    network: NetworkSettings = scale_invariant()

    @property
    def steps(self) -> int:
        """How many steps that makes, the last epoch whole."""
        return -(-self.clouds * self.epochs // self.batch)


def train_synthetic(
    run: SyntheticRun,
    clips: tuple[Clip, ...],
    out: Path,
    progress: Progress = lambda note, steps: None,
) -> dict[str, float]:
    """Train into ``out``: ``weights.safetensors``, ``figures.json``, ``checkpoint.safetensors``.

    Returns the figures on clouds that were not trained on: accuracy and mean IoU, precision, and
    the recall of pole points and of edge points each.

    Raises
    ------
    InputError
        where ``out`` holds the checkpoint of a run with other settings.
    OutputError
        where it cannot be written.
    """
    prepare_run_folder(out)
    torch.manual_seed(run.seed)
    network = SuperLine3D(run.network)
    fit(
        network,
        synthetic_samples(run, clips),
        fit_settings(run),
        out / "checkpoint.safetensors",
        progress,
    )
    figures = held_out_figures(network, run, clips)
    about = {"stage": "synthetic", "seed": str(run.seed), "clouds": str(run.clouds)}
    save_weights(out / "weights.safetensors", network, about)
    write_json(out / "figures.json", {"run": run.model_dump(), "figures": figures})
    return figures


def fit_settings(run: SyntheticRun) -> FitSettings:
    """Return how such a run is fitted."""
    return FitSettings(
        steps=run.steps,
        learning_rate=run.learning_rate,
        num_neighbours=run.network.num_neighbours,
        stride=run.network.stride,
    )


def synthetic_samples(run: SyntheticRun, clips: tuple[Clip, ...]) -> Callable[[int], list[Sample]]:
    """Return what each step is trained on; every epoch has the clouds in another order."""
    first = range(min(NUM_WEIGHED, run.clouds))
    weights = kind_weights([cloud_of(run, clips, index).kinds for index in first])

    def samples_of(step: int) -> list[Sample]:
        samples = []
        for position in range(step * run.batch, (step + 1) * run.batch):
            epoch, place = divmod(position, run.clouds)
            order = np.random.default_rng([run.seed, 1, epoch]).permutation(run.clouds)
            cloud = cloud_of(run, clips, int(order[place]))
            samples.append(Sample(cloud.points, cloud.line_id >= 0, weights[cloud.kinds]))
        return samples

    return samples_of


def cloud_of(run: SyntheticRun, clips: tuple[Clip, ...], index: int) -> SyntheticCloud:
    """Return a cloud of the run."""
    return synthetic_cloud(run.seed, index, clips, run.shapes)


def held_out_figures(
    network: SuperLine3D, run: SyntheticRun, clips: tuple[Clip, ...], count: int = NUM_TEST_CLOUDS
) -> dict[str, float]:
    """Return how well clouds are told that were not trained on."""
    total, poles, edges = Agreement(), Agreement(), Agreement()
    for index in range(FIRST_TEST_CLOUD, FIRST_TEST_CLOUD + count):
        cloud = cloud_of(run, clips, index)
        settings = run.network
        (shares,) = line_shares(network, [cloud.points], settings.num_neighbours, settings.stride)
        found, is_pole = shares > 0.5, cloud.kinds == LineKind.POLE
        total = total.plus(found, cloud.line_id >= 0)
        poles = poles.plus(found[is_pole], np.ones(int(is_pole.sum()), bool))
        is_edge = (cloud.line_id >= 0) & ~is_pole
        edges = edges.plus(found[is_edge], np.ones(int(is_edge.sum()), bool))
    return {
        "accuracy": round(total.accuracy, 4),
        "mean_iou": round(total.mean_iou, 4),
        "precision": round(total.precision, 4),
        "pole_recall": round(poles.recall, 4),
        "edge_recall": round(edges.recall, 4),
    }

"""``sl3d bench scale``: who still finds lines when the world is smaller or larger (Fig. 7).

Simulated shapes: every network is trained on the same clouds in the unit cube, for the same number
of steps, and tested on others that are scaled by 0.1 to 3.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import nn

from sl3d_slam.bench.scale_picture import draw_scales
from sl3d_slam.bench.tables import Column, Table, write_tables
from sl3d_slam.files import prepare_run_folder, write_whole
from sl3d_slam.learning.background import simulated_clips
from sl3d_slam.learning.baselines import Dgcnn, PointNet, PointNet2
from sl3d_slam.learning.segmentation import Agreement, PointNetwork, line_shares
from sl3d_slam.learning.segmentation_trainer import FitSettings, fit
from sl3d_slam.learning.synthetic import SyntheticCloud, SyntheticSettings
from sl3d_slam.learning.synthetic_training import (
    FIRST_TEST_CLOUD,
    SyntheticRun,
    cloud_of,
    scale_invariant,
    synthetic_samples,
)
from sl3d_slam.lines.network.model import SuperLine3D

SCALES = (0.1, 0.2, 0.4, 0.6, 0.8, 1.0, 1.2, 1.6, 2.0, 2.5, 3.0)
OURS = "ours, scale-invariant"
Progress = Callable[[str, int], None]


@dataclass(frozen=True, slots=True)
class Extent:
    """How much is done: training clouds and steps, points of a cloud, test clouds, width."""

    clouds: int
    epochs: int
    points: int
    test_clouds: int
    width: int
    neighbours: int


QUICK = Extent(clouds=240, epochs=1, points=1000, test_clouds=12, width=32, neighbours=20)
FULL = Extent(clouds=4000, epochs=1, points=1500, test_clouds=60, width=48, neighbours=20)


@dataclass(frozen=True, slots=True)
class ScaleRow:
    """One network at one scale of the test clouds."""

    method: str
    scale: float
    accuracy: float
    mean_iou: float


def num_steps(quick: bool) -> int:
    """Return how many steps of progress there are."""
    return len(_networks(QUICK)) * _run_of(QUICK if quick else FULL, 0).steps


def run(
    out: Path,
    quick: bool,
    seed: int = 0,
    command: str = "sl3d bench scale",
    progress: Progress = lambda note, steps: None,
) -> list[Table]:
    """Train and test all networks; leave ``scale.csv``, ``.md`` and ``.png`` in ``out``.

    Raises
    ------
    OutputError
        where ``out`` cannot be written.
    """
    prepare_run_folder(out)
    rows = measure(QUICK if quick else FULL, seed, progress)
    tables = _tables(rows, QUICK if quick else FULL)
    write_tables(out, "scale", tables, command)
    write_whole(out / "scale.png", draw_scales(rows))
    return tables


def measure(extent: Extent, seed: int, progress: Progress) -> list[ScaleRow]:
    """Train each network on the same clouds and test it at every scale."""
    clips = simulated_clips(seed)
    trained_as = _run_of(extent, seed)
    first = range(FIRST_TEST_CLOUD, FIRST_TEST_CLOUD + extent.test_clouds)
    test = [cloud_of(trained_as, clips, index) for index in first]
    samples_of = synthetic_samples(trained_as, clips)
    rows = []
    for method, (make, stride) in _networks(extent).items():
        torch.manual_seed(seed)
        network = make()
        fitting = FitSettings(
            steps=trained_as.steps,
            learning_rate=trained_as.learning_rate,
            num_neighbours=extent.neighbours,
            stride=stride,
        )
        fit(
            network,
            samples_of,
            fitting,
            None,
            _told(progress, method),
        )
        asked = (network, extent.neighbours, stride)
        rows += [_judge(asked, method, scale, test) for scale in SCALES]
    return rows


def _told(progress: Progress, method: str) -> Progress:
    """Return a progress that names the network it is about."""
    return lambda note, steps: progress(f"{method}, {note}", steps)


def _networks(extent: Extent) -> dict[str, tuple[Callable[[], nn.Module], int]]:
    """Return how each network is made and the stride of its neighbours in space."""
    ours = scale_invariant(extent.width, extent.neighbours)
    return {
        "PointNet": (lambda: PointNet(extent.width), 1),
        "PointNet++": (lambda: PointNet2(extent.width), 1),
        "DGCNN": (lambda: Dgcnn(extent.width, extent.neighbours), 1),
        OURS: (lambda: SuperLine3D(ours), ours.stride),
    }


def _run_of(extent: Extent, seed: int) -> SyntheticRun:
    """Return the training run: the paper's clouds of one shape, a fifth of them background."""
    background = extent.points // 5
    shapes = SyntheticSettings(
        primitive_points=extent.points - background,
        background_points=background,
        max_primitives=1,
        scanned=0.0,
    )
    return SyntheticRun(
        seed=seed,
        clouds=extent.clouds,
        epochs=extent.epochs,
        batch=4,
        learning_rate=2e-3,
        shapes=shapes,
    )


def _judge(
    asked: tuple[PointNetwork, int, int], method: str, scale: float, test: list[SyntheticCloud]
) -> ScaleRow:
    network, num_neighbours, stride = asked
    total = Agreement()
    for cloud in test:
        (shares,) = line_shares(network, [cloud.points * scale], num_neighbours, stride)
        total = total.plus(shares > 0.5, cloud.line_id >= 0)
    return ScaleRow(method, scale, total.accuracy, total.mean_iou)


def _tables(rows: list[ScaleRow], extent: Extent) -> list[Table]:
    steps = _run_of(extent, 0).steps
    note = (
        f"simulated shapes; each network trained for {steps} steps of 4 clouds of "
        f"{extent.points} points, tested on {extent.test_clouds} others"
    )
    tables = []
    for key, title in (("mean_iou", "Mean IoU"), ("accuracy", "Accuracy")):
        methods = dict.fromkeys(row.method for row in rows)
        cells = [
            {"method": method}
            | {f"{r.scale:g}": getattr(r, key) for r in rows if r.method == method}
            for method in methods
        ]
        columns = [Column("method", "network")]
        columns += [
            Column(f"{scale:g}", f"x{scale:g}", "{:.3f}", main=scale in (0.1, 1.0, 3.0))
            for scale in SCALES
        ]
        tables.append(Table(f"{title} of line segmentation over scale", columns, cells, [note]))
    return tables

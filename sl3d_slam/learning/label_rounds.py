"""``sl3d train label``: vote, grow, confirm, refine the network on the labels, and once more.

``OUT`` gets ``roundR/votes`` and ``roundR/labels``, a file a scan, ``roundR/weights.safetensors``,
the network refined on the labels of the round. The labels of the last round are in ``OUT/labels``,
drawn in ``OUT/pictures``. Whatever is there already is not made again.
"""

import multiprocessing
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from sl3d_slam.errors import InputError
from sl3d_slam.files import prepare_run_folder, write_whole
from sl3d_slam.io.dataset import Dataset
from sl3d_slam.learning.label_lines import ScanLines, judge_lines, split_by_sight
from sl3d_slam.learning.label_pictures import draw_labels
from sl3d_slam.learning.label_poses import drive_poses
from sl3d_slam.learning.label_truth import LabelScore, read_town_truth
from sl3d_slam.learning.labelling import (
    LabelSettings,
    ScanWorker,
    Source,
    load_segmentation,
    read_candidates,
)
from sl3d_slam.learning.labels import UNKNOWN, label_points, read_labels, write_labels
from sl3d_slam.learning.refinement import RefineSettings, refine

Progress = Callable[[str, int], None]
_worker: ScanWorker | None = None  # one a process of the pool


@dataclass(frozen=True, slots=True)
class LabelRun:
    """What to label, from what weights, how often, in how many processes.

    ``every`` takes each so-many-th scan of a drive, ``scans`` only those among the first so many.
    """

    source: Source
    weights: Path
    rounds: int = 3
    workers: int = 1
    every: int = 1
    scans: int | None = None
    settings: LabelSettings = field(default_factory=LabelSettings)
    refinement: RefineSettings = field(default_factory=RefineSettings)

    def indices(self, dataset: Dataset) -> list[int]:
        """Return which scans are labelled."""
        count = len(dataset) if self.scans is None else min(self.scans, len(dataset))
        return list(range(0, count, self.every))

    def num_steps(self) -> int:
        """Return how many steps of progress there are, those of refinement among them."""
        labelled = (2 * self.rounds + 1) * len(self.indices(self.source.open()))
        return labelled + (self.rounds - 1) * self.refinement.steps


@dataclass(frozen=True, slots=True)
class RoundFigures:
    """One round: lines a scan, the share of points not known; a score where the truth is known."""

    number: int
    scans: int
    lines_per_scan: float
    unknown_share: float
    score: LabelScore | None


def run_rounds(
    run: LabelRun, out: Path, progress: Progress = lambda note, steps: None
) -> list[RoundFigures]:
    """Label a drive; return the figures of each round.

    Raises
    ------
    InputError
        naming data, weights or a damaged file of an earlier run.
    OutputError
        where ``out`` cannot be written.
    """
    load_segmentation(run.weights)  # refused now rather than after the odometry
    prepare_run_folder(out)
    _refuse_other_run(run, out)
    dataset = run.source.open()
    indices = run.indices(dataset)
    T_world_lidar = drive_poses(run.source, dataset, max(indices) + 1, out)[indices]
    figures, weights = [], run.weights
    for number in range(1, run.rounds + 1):
        folder = out / f"round{number}"
        for name in ("votes", "labels"):
            prepare_run_folder(folder / name)
        for _ in _vote(run, weights, folder / "votes", indices):
            progress(f"round {number}: votes", 1)
        found = [read_candidates(folder / "votes" / f"{index:06d}.npz") for index in indices]
        judged = judge_lines(found, T_world_lidar, run.settings.confirmation)
        for index, lines in zip(indices, judged, strict=True):
            _label_scan(dataset, folder, index, lines, run.settings)
            progress(f"round {number}: labels", 1)
        labels = folder / "labels"
        figures.append(_figures(run, dataset, number, labels, indices, T_world_lidar))
        if number < run.rounds:
            weights = refine(weights, dataset, indices, folder, run.refinement, progress)
    for _ in _publish(dataset, out, run.rounds, indices):
        progress("pictures", 1)
    return figures


def _refuse_other_run(run: LabelRun, out: Path) -> None:
    """Raise where a folder holds labels made in another way: nobody could tell them apart."""
    about = "\n".join(
        [
            f"data: {Path(run.source.data).resolve()} {run.source.sequence or ''}",
            f"weights: {run.weights.resolve()}",
            f"every: {run.every}",
            f"settings: {run.settings.model_dump_json()}",
            f"refinement: {run.refinement.model_dump_json()}\n",
        ]
    )
    path = out / "run.txt"
    if path.is_file() and path.read_text(encoding="utf-8") != about:
        raise InputError(f"{path}: these labels were made in another way; name another folder")
    write_whole(path, about)


def _vote(run: LabelRun, weights: Path, folder: Path, indices: list[int]) -> Iterator[None]:
    """Yield as scans are done; those that are there already come first."""
    todo = [index for index in indices if not (folder / f"{index:06d}.npz").is_file()]
    yield from (None for _ in range(len(indices) - len(todo)))
    start = (run.source, weights, folder, run.settings)
    if run.workers == 1 or len(todo) < 2:
        worker = ScanWorker(*start)
        yield from map(worker.vote, todo)
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(run.workers, context, _start_worker, start) as pool:
        yield from pool.map(_vote_in_worker, todo)


def _start_worker(source: Source, weights: Path, folder: Path, settings: LabelSettings) -> None:
    global _worker
    _worker = ScanWorker(source, weights, folder, settings)


def _vote_in_worker(index: int) -> None:
    assert _worker is not None  # the pool has called _start_worker
    _worker.vote(index)


def _label_scan(
    dataset: Dataset, folder: Path, index: int, lines: ScanLines, settings: LabelSettings
) -> None:
    """Write the labels of a scan, unless they are there already."""
    path = folder / "labels" / f"{index:06d}.npz"
    if path.is_file():
        return
    (scan,) = dataset.iterate(index, index + 1)
    sure, doubtful = split_by_sight(scan.points_lidar, lines, settings.growth)
    write_labels(path, label_points(scan.points_lidar, lines.votes, sure, doubtful))


def _figures(
    run: LabelRun,
    dataset: Dataset,
    number: int,
    folder: Path,
    indices: list[int],
    T_world_lidar: np.ndarray,
) -> RoundFigures:
    """Measure the labels as they were written."""
    labels = [read_labels(folder / f"{index:06d}.npz") for index in indices]
    truth = read_town_truth(run.source.folder()) if dataset.simulated else None
    score = None
    if truth is not None:
        scores = [
            truth.score(index, found.endpoints.astype(float), T, not run.settings.lying)
            for index, found, T in zip(indices, labels, T_world_lidar, strict=True)
        ]
        score = sum(scores, LabelScore())
    return RoundFigures(
        number=number,
        scans=len(indices),
        lines_per_scan=float(np.mean([len(found.endpoints) for found in labels])),
        unknown_share=float(np.mean([np.mean(found.line_id == UNKNOWN) for found in labels])),
        score=score,
    )


def _publish(dataset: Dataset, out: Path, rounds: int, indices: list[int]) -> Iterator[None]:
    """Copy the labels of the last round to where training looks, and draw them."""
    for name in ("labels", "pictures"):
        prepare_run_folder(out / name)
    for index in indices:
        name = f"{index:06d}"
        labels = read_labels(out / f"round{rounds}" / "labels" / f"{name}.npz")
        write_labels(out / "labels" / f"{name}.npz", labels)
        picture = out / "pictures" / f"{name}.png"
        if not picture.is_file():
            (scan,) = dataset.iterate(index, index + 1)
            title = f"{dataset.name} scan {index}"
            write_whole(picture, draw_labels(scan.points_lidar, labels, title))
        yield

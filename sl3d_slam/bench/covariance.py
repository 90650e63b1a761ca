"""``sl3d bench covariance``: are the covariances of loops and of odometry steps honest?

The normalised error squared ``e^T P^-1 e`` of six honest degrees of freedom is six on average. Its
mean over a drive with true poses is what the covariances are calibrated by: run it on drives for
calibration, change ``matching/dense.py`` (loops) or ``odometry/noise.py`` (steps), then run it on
others. Loops are pairs of views of one place, refined from a guess some decimetres off the truth,
that the loop search would have believed.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from sl3d_slam.bench.drives import Drive
from sl3d_slam.bench.tables import Column, Table, write_tables
from sl3d_slam.config import SlamConfig
from sl3d_slam.errors import InputError
from sl3d_slam.files import prepare_run_folder
from sl3d_slam.geometry.se3 import distances_travelled_m, exp, invert, log
from sl3d_slam.graph.final import PoseCovariances, odometry_edges
from sl3d_slam.graph.noise import Matrix6
from sl3d_slam.io.dataset import Dataset
from sl3d_slam.keyframes import KeyframeSelector
from sl3d_slam.lines.extract import LineExtractor
from sl3d_slam.matching.judge import gather_evidence, objection
from sl3d_slam.matching.prepared import PreparedView
from sl3d_slam.matching.views import make_view
from sl3d_slam.odometry.odometry import Odometry

GUESS_SIGMAS = np.array([0.005, 0.005, 0.02, 0.4, 0.4, 0.2])  # rad, m
SETTLING_SCANS = 2  # before the odometry has a velocity
Progress = Callable[[str, int], None]
Errors = Float64[np.ndarray, "N 6"]

COLUMNS = (
    Column("drive", "drive"),
    Column("kind", "what"),
    Column("count", "number"),
    Column("nees_mean", "NEES mean", "{:.2f}"),
    Column("nees_median", "median", "{:.2f}"),
    Column("nees_p95", "95 %", "{:.1f}"),
    Column("rms_deg", "rms error deg", "{:.4f}", main=False),
    Column("rms_m", "rms error m", "{:.4f}", main=False),
)


@dataclass(frozen=True, slots=True)
class CovarianceBench:
    """What is measured: drives with true poses, and how many pairs of views of each."""

    drives: Sequence[Drive]
    config: SlamConfig
    num_pairs: int = 150
    min_travel_m: float = 40.0
    seed: int = 0


def run(
    what: CovarianceBench,
    out: Path,
    command: str = "sl3d bench covariance",
    progress: Progress = lambda note, steps: None,
) -> Table:
    """Measure every drive; leave ``covariance.csv``, ``.md`` and ``_table.png`` in ``out``.

    Raises
    ------
    InputError
        where a drive has no true poses or cannot be read.
    OutputError
        where ``out`` cannot be written.
    """
    prepare_run_folder(out)
    rows: list[dict[str, Any]] = []
    for drive in what.drives:
        rows += measure(drive, what, progress)
    title = "Normalised error squared of loops and odometry steps (honest: 6 on average)"
    table = Table(title, COLUMNS, rows)
    write_tables(out, "covariance", [table], command)
    return table


def measure(drive: Drive, what: CovarianceBench, progress: Progress) -> list[dict[str, Any]]:
    """Return one row for the loops of a drive and one for its odometry steps."""
    dataset = drive.open(what.config.input)
    if dataset.truth is None:
        raise InputError(f"{dataset.name}: has no true poses; expected some to measure errors by")
    poses, covariances, views = _drive_through(drive, dataset, what.config, progress)
    truth = dataset.truth[: len(poses)]
    name = f"{dataset.name}{' (simulated)' if dataset.simulated else ''}"
    progress(f"{dataset.name} pairs", 0)
    return [
        _row(name, "loops", *loop_errors(views, truth, what)),
        _row(name, "odometry steps", *step_errors(poses, truth, what.config, covariances)),
    ]


def step_errors(
    T_odom_lidar: np.ndarray,
    truth: np.ndarray,
    config: SlamConfig,
    pose_covariances: PoseCovariances = (),
) -> tuple[Errors, Float64[np.ndarray, "N"]]:
    """Return each step's error at the newer scan, and its normalised square."""
    errors, squared = np.zeros((0, 6)), []
    edges = odometry_edges(T_odom_lidar, config.graph, pose_covariances)
    for edge in edges[SETTLING_SCANS:]:
        true_step = invert(truth[edge.first]) @ truth[edge.second]
        error = log(invert(true_step) @ edge.T_first_second)
        errors = np.vstack([errors, error])
        squared.append(error @ edge.information @ error)
    return errors, np.array(squared)


def loop_errors(
    views: dict[int, PreparedView], truth: np.ndarray, what: CovarianceBench
) -> tuple[Errors, Float64[np.ndarray, "N"]]:
    """Return each believed loop's error at the query, and its normalised square."""
    rng = np.random.default_rng(what.seed)
    pairs = _pairs(sorted(views), truth, what)
    needed = what.config.loops.judging(what.config.matching)
    errors, squared = np.zeros((0, 6)), []
    for target, query in rng.permutation(pairs)[: what.num_pairs].tolist():
        T_target_query = invert(truth[target]) @ truth[query]
        guess = T_target_query @ exp(GUESS_SIGMAS * rng.standard_normal(6))
        evidence = gather_evidence(views[query], views[target], guess, what.config.matching)
        if evidence is None or objection(evidence, needed):
            continue
        error = log(invert(T_target_query) @ evidence.T_target_source)
        errors = np.vstack([errors, error])
        squared.append(error @ evidence.information @ error)
    return errors, np.array(squared)


def _pairs(scans: Sequence[int], truth: np.ndarray, what: CovarianceBench) -> np.ndarray:
    """Return (target, query) scans near each other that lie apart on the way."""
    positions = truth[:, :3, 3]
    way_m = distances_travelled_m(positions)
    pairs = [
        (target, query)
        for query in scans
        for target in scans
        if way_m[query] - way_m[target] > what.min_travel_m
        and np.linalg.norm(positions[query] - positions[target]) < what.config.loops.max_distance_m
    ]
    return np.array(pairs, np.int64).reshape(-1, 2)


def _drive_through(
    drive: Drive, dataset: Dataset, config: SlamConfig, progress: Progress
) -> tuple[np.ndarray, list[Matrix6 | None], dict[int, PreparedView]]:
    odometry = Odometry(config.odometry, config.input)
    selector = KeyframeSelector(config.keyframes)
    extractor = LineExtractor(config.lines)
    poses, covariances, views = [], [], {}
    for scan in drive.stream(dataset):
        registered = odometry.register(scan)
        poses.append(registered.T_odom_lidar)
        covariances.append(registered.covariance)
        if selector.add(registered) is not None:
            lines = extractor.extract(registered.points_lidar)
            view = make_view(registered.points_lidar, lines, config.matching.cloud_voxel_m)
            views[scan.index] = PreparedView(view, config.matching)
        progress(dataset.name, 1)
    return np.array(poses), covariances, views


def _row(
    drive: str, kind: str, errors: Errors, squared: Float64[np.ndarray, "N"]
) -> dict[str, Any]:
    row: dict[str, Any] = {"drive": drive, "kind": kind, "count": len(squared)}
    if len(squared) == 0:
        return row
    return row | {
        "nees_mean": float(squared.mean()),
        "nees_median": float(np.median(squared)),
        "nees_p95": float(np.percentile(squared, 95)),
        "rms_deg": float(np.degrees(np.sqrt((errors[:, :3] ** 2).sum(axis=1).mean()))),
        "rms_m": float(np.sqrt((errors[:, 3:] ** 2).sum(axis=1).mean())),
    }

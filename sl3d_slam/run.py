"""What a run leaves: numbers, files and pictures, each written whole or not at all."""

import platform
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from sl3d_slam import __version__
from sl3d_slam.config import SlamConfig, dump_config
from sl3d_slam.files import prepare_run_folder, write_whole
from sl3d_slam.io.covariances import write_covariances
from sl3d_slam.io.dataset import Dataset
from sl3d_slam.io.json_files import write_json
from sl3d_slam.io.trajectory import to_camera_frame, write_kitti_poses, write_tum
from sl3d_slam.mapping.facts import map_facts
from sl3d_slam.mapping.georeference import georeference_tree
from sl3d_slam.mapping.line_map import LineMap
from sl3d_slam.memory import own_peak_mb
from sl3d_slam.report.map_pictures import draw_map
from sl3d_slam.report.metrics import ate_rmse_m, count_false_loops, kitti_errors
from sl3d_slam.report.trajectory import draw_trajectory
from sl3d_slam.types import KeyframeCovariances, LoopRecord, Trajectory

REPORTED_PACKAGES = ("numpy", "scipy", "numba", "gtsam", "kiss-icp", "small_gicp", "torch")


@dataclass
class StageTimes:
    """Seconds of every call of every stage."""

    seconds: dict[str, list[float]] = field(default_factory=dict)

    def add(self, stage: str, duration_s: float) -> None:
        """Note one call."""
        self.seconds.setdefault(stage, []).append(duration_s)

    @contextmanager
    def measured(self, stage: str) -> Iterator[None]:
        """Note how long a block takes."""
        start_s = time.perf_counter()
        yield
        self.add(stage, time.perf_counter() - start_s)

    def summary(self) -> dict[str, dict[str, float]]:
        """Return mean and 99th percentile in milliseconds, by stage."""
        return {
            stage: {
                "mean_ms": 1e3 * float(np.mean(times)),
                "p99_ms": 1e3 * float(np.percentile(times, 99)),
                "calls": len(times),
            }
            for stage, times in self.seconds.items()
        }


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """A finished drive.

    Attributes
    ----------
    trajectory : optimised ``T_world_lidar`` of every scan; the world is the first scan's frame.
    odometry : ``T_odom_lidar`` of every scan.
    loops : every verified candidate, with what became of it.
    graph_g2o : the final graph as a g2o file's text.
    line_map : the landmarks, in the world frame.
    world : what became of GPS and gravity, where given.
    covariances : marginals of the keyframes, where asked for.
    workers_peak_mb : the most memory that worker processes held of their own.
    """

    config: SlamConfig
    trajectory: Trajectory
    odometry: Trajectory
    loops: list[LoopRecord]
    graph_g2o: str
    line_map: LineMap
    num_keyframes: int
    times: StageTimes
    world: dict[str, Any] | None = None
    covariances: KeyframeCovariances | None = None
    workers_peak_mb: float = 0.0

    def metrics(self, dataset: Dataset | None = None) -> dict[str, Any]:
        """Return the content of ``metrics.json``; truth-based figures only where truth is known."""
        poses = self.trajectory.T_world_lidar
        length_m = float(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum())
        statuses = [loop.status for loop in self.loops]
        map_size = map_facts(self.line_map)
        figures: dict[str, Any] = {
            "simulated": bool(dataset is not None and dataset.simulated),
            "num_scans": len(poses),
            "num_keyframes": self.num_keyframes,
            "length_m": length_m,
            "loops_accepted": statuses.count("accepted"),
            "loops_rejected": statuses.count("rejected"),
            "loops_revoked": statuses.count("revoked"),
            "num_lines": len(self.line_map.lines),
            "map_kb_per_km": map_size["kb_per_km"],
            "map_lines_kb_per_km": map_size["lines_kb_per_km"],
            "peak_rss_mb": own_peak_mb() + self.workers_peak_mb,
            "stages": self.times.summary(),
        }
        truth = None if dataset is None or dataset.truth is None else dataset.truth[: len(poses)]
        if truth is not None:
            kitti = kitti_errors(poses, truth)
            figures |= {
                "ate_rmse_m": ate_rmse_m(poses, truth),
                "odometry_ate_rmse_m": ate_rmse_m(self.odometry.T_world_lidar, truth),
                "kitti_translation_percent": kitti[0] if kitti else None,
                "kitti_rotation_deg_per_m": kitti[1] if kitti else None,
                "loops_false": count_false_loops(self.loops, truth),
            }
        return figures

    def save(
        self,
        folder: Path | str,
        dataset: Dataset | None = None,
        extra_figures: Mapping[str, Any] | None = None,
    ) -> dict[str, Any]:
        """Write everything into a folder and return the metrics.

        Raises
        ------
        OutputError
            where the folder cannot be written; files already there are replaced one by one, whole.
        """
        folder = prepare_run_folder(Path(folder))
        write_tum(folder / "poses_tum.txt", self.trajectory)
        write_tum(folder / "odometry_tum.txt", self.odometry)
        if dataset is not None and dataset.T_cam_lidar is not None:
            poses = to_camera_frame(self.trajectory.T_world_lidar, dataset.T_cam_lidar)
            write_kitti_poses(folder / "poses_kitti.txt", poses)
        write_json(folder / "loops.json", [loop_tree(loop) for loop in self.loops])
        write_whole(folder / "graph.g2o", self.graph_g2o)
        self.line_map.save(folder / "map.sl3d")
        if self.covariances is not None:
            stamps_s = self.trajectory.stamps_s
            write_covariances(folder / "covariance.txt", self.covariances, stamps_s)
        write_whole(folder / "config.yaml", dump_config(self.config))
        self._draw(folder, dataset)
        figures = self.metrics(dataset) | dict(extra_figures or {})
        write_json(folder / "metrics.json", figures)
        write_json(folder / "run.json", _provenance(self, dataset))
        return figures

    def _draw(self, folder: Path, dataset: Dataset | None) -> None:
        name = "a drive" if dataset is None else dataset.name
        if dataset is not None and dataset.simulated:
            name += " (simulated)"
        truth = None
        if dataset is not None and dataset.truth is not None:
            truth = dataset.truth[: len(self.trajectory)]
        picture = draw_trajectory(self.trajectory, self.odometry, truth, self.loops, name)
        write_whole(folder / "trajectory.png", picture)
        write_whole(folder / "map.png", draw_map(self.line_map.lines, self.trajectory, name))


def loop_tree(loop: LoopRecord) -> dict[str, Any]:
    """Return a candidate as ``loops.json`` holds it."""
    return {
        "query_scan": loop.query_scan,
        "target_scan": loop.target_scan,
        "T_target_query": loop.T_target_query.tolist(),
        "num_inliers": loop.num_inliers,
        "status": loop.status,
        "reason": loop.reason,
    }


def _provenance(run: Run, dataset: Dataset | None) -> dict[str, Any]:
    return {
        "sl3d_slam": __version__,
        "python": platform.python_version(),
        "platform": platform.platform(),
        "packages": {name: metadata.version(name) for name in REPORTED_PACKAGES},
        "seed": run.config.seed,
        "input": None if dataset is None else dataset.description,
        "simulated": bool(dataset is not None and dataset.simulated),
        "warnings": [] if dataset is None else list(dataset.warnings),
        "world": run.world,
        "georeference": georeference_tree(run.line_map.origin.georeference),
    }

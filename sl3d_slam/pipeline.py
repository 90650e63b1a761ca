"""A whole drive: scans in, trajectory, loops, graph and line map out.

``process_scan`` is the order of the stages; each does its work in its own module.
"""

import time
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from jaxtyping import Float64

from sl3d_slam.closing import LoopCloser
from sl3d_slam.config import SlamConfig, dump_config
from sl3d_slam.errors import InputError
from sl3d_slam.graph.final import optimise_all_scans
from sl3d_slam.graph.pose_graph import PoseGraph
from sl3d_slam.io.points import usable
from sl3d_slam.keyframes import KeyframeSelector
from sl3d_slam.mapping.line_map import LineMap, MapOrigin
from sl3d_slam.odometry import Odometry
from sl3d_slam.run import Run, StageTimes
from sl3d_slam.types import LoopConstraint, LoopRecord, RegisteredScan, Rejection, Scan, Trajectory


class SlamPipeline:
    """Maps a drive scan by scan.

    Example
    -------
    >>> slam = SlamPipeline(load_config())
    >>> for points in scans:
    ...     slam.process_scan(points)
    >>> run = slam.finish()
    """

    def __init__(self, config: SlamConfig | None = None, simulated: bool = False) -> None:
        """Start with no scan; ``simulated`` labels what comes out."""
        self.config = config or SlamConfig()
        self._simulated = simulated
        self._odometry = Odometry(self.config.odometry, self.config.input)
        self._keyframes = KeyframeSelector(self.config.keyframes)
        self._closer = LoopCloser(self.config)
        self._graph = PoseGraph(self.config.graph)
        self._stamps_s: list[float] = []
        self._T_odom_lidar: list[np.ndarray] = []
        self._scan_of_keyframe: dict[int, int] = {}
        self._rejections: list[Rejection] = []
        self._times = StageTimes()

    @property
    def num_loops(self) -> int:
        """The number of loops accepted now."""
        return len(self._graph.accepted_loops)

    def process_scan(
        self,
        points_lidar: np.ndarray,
        stamps: np.ndarray | None = None,
        stamp_s: float | None = None,
    ) -> RegisteredScan:
        """Take the next scan: (N, 3) metres in the lidar frame.

        ``stamps`` are the times of the points in seconds, for deskewing; ``stamp_s`` is the time of
        the scan (default: a tenth of a second after the last). Points that are not finite or out
        of range are left out; a scan with too few points left raises InputError.
        """
        index = len(self._stamps_s)
        points = np.asarray(points_lidar, np.float64)
        if points.ndim != 2 or points.shape[1] != 3:
            raise InputError(f"scan {index}: shape {points.shape}, expected (N, 3) in metres")
        keep = usable(points, self.config.input, f"scan {index}")
        times = None if stamps is None else _checked_stamps(stamps, len(points), index)[keep]
        if stamp_s is None:
            stamp_s = self._stamps_s[-1] + 0.1 if self._stamps_s else 0.0
        return self.process(Scan(index, stamp_s, np.ascontiguousarray(points[keep]), times))

    def process(self, scan: Scan) -> RegisteredScan:
        """Take the next scan as a reader gives it."""
        with self._timed("scan"):
            with self._timed("odometry"):
                registered = self._odometry.register(scan)
            self._stamps_s.append(scan.stamp_s)
            self._T_odom_lidar.append(registered.T_odom_lidar)
            keyframe = self._keyframes.add(registered)
            if keyframe is not None:
                with self._timed("lines"):
                    view = self._closer.make_view(keyframe.points_lidar)
                    self._closer.add(keyframe.id, view, keyframe.T_odom_lidar)
                self._extend_graph(keyframe.id)
                self._close_loops(keyframe.id)
        return registered

    def finish(self) -> Run:
        """Optimise over all scans and build the map; the pipeline may not be used afterwards."""
        if not self._stamps_s:
            raise InputError("no scan was given, so there is nothing to map")
        with self._timed("final"):
            self._graph.settle()
            T_odom_lidar = np.array(self._T_odom_lidar)
            final = optimise_all_scans(
                T_odom_lidar,
                self._scan_of_keyframe,
                self._graph.estimates(),
                self._graph.accepted_loops,
                self.config.graph,
            )
        with self._timed("map"):
            line_map = self._build_map(final.T_world_lidar)
        stamps_s = np.array(self._stamps_s)
        return Run(
            config=self.config,
            trajectory=Trajectory(stamps_s, final.T_world_lidar),
            odometry=Trajectory(stamps_s, T_odom_lidar),
            loops=self._loop_records(),
            graph_g2o=final.to_g2o(),
            line_map=line_map,
            num_keyframes=len(self._scan_of_keyframe),
            times=self._times,
        )

    def _extend_graph(self, keyframe_id: int) -> None:
        scan_index = len(self._stamps_s) - 1
        last = self._scan_of_keyframe.get(keyframe_id - 1, scan_index)
        self._scan_of_keyframe[keyframe_id] = scan_index
        with self._timed("graph"):
            self._graph.add_keyframe(keyframe_id, self._T_odom_lidar[-1], scan_index - last)

    def _close_loops(self, keyframe_id: int) -> None:
        if not self.config.loops.enabled:
            return
        with self._timed("loops"):
            outcomes = self._closer.search(keyframe_id, self._graph.estimates())
        for outcome in outcomes:
            if isinstance(outcome, LoopConstraint):
                with self._timed("graph"):
                    self._graph.add_loop(outcome)
            else:
                self._rejections.append(outcome)

    def _build_map(self, T_world_lidar: Float64[np.ndarray, "N 4 4"]) -> LineMap:
        scans = list(self._scan_of_keyframe.values())
        views = [self._closer.view(keyframe_id) for keyframe_id in self._scan_of_keyframe]
        return LineMap.build(
            [view.lines for view in views],
            T_world_lidar[scans],
            np.array([view.up for view in views]),
            [view.cloud for view in views] if self.config.map.clouds else None,
            self.config.map,
            MapOrigin(config=dump_config(self.config), simulated=self._simulated),
        )

    def _loop_records(self) -> list[LoopRecord]:
        records = [
            self._record(verdict.loop, verdict.status, verdict.reason)
            for verdict in self._graph.verdicts
        ]
        records += [self._record(no, "rejected", no.reason) for no in self._rejections]
        return sorted(records, key=lambda record: (record.query_scan, record.target_scan))

    def _record(
        self, candidate: LoopConstraint | Rejection, status: str, reason: str
    ) -> LoopRecord:
        T_target_query = candidate.T_target_query
        assert T_target_query is not None  # every verified candidate has a pose
        return LoopRecord(
            self._scan_of_keyframe[candidate.query_id],
            self._scan_of_keyframe[candidate.target_id],
            T_target_query,
            candidate.num_inliers,
            status,
            "" if status == "accepted" else reason,
        )

    @contextmanager
    def _timed(self, stage: str) -> Iterator[None]:
        start_s = time.perf_counter()
        yield
        self._times.add(stage, time.perf_counter() - start_s)


def _checked_stamps(stamps: np.ndarray, count: int, index: int) -> Float64[np.ndarray, "N"]:
    times = np.asarray(stamps, np.float64)
    if times.shape != (count,) or not np.isfinite(times).all():
        raise InputError(
            f"scan {index}: stamps of shape {times.shape} for {count} points; "
            "expected a finite time in seconds for each point"
        )
    return times

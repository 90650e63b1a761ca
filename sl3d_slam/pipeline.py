"""A whole drive: scans in, trajectory, loops, graph and line map out.

``process`` is the order of the stages; each does its work in its own module.
"""

import time
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from sl3d_slam.closing import KeptClouds, LoopCloser
from sl3d_slam.config import SlamConfig, dump_config
from sl3d_slam.errors import InputError
from sl3d_slam.geometry.geodesy import GeoReference
from sl3d_slam.geometry.se3 import Transform
from sl3d_slam.graph.final import keyframe_covariances, optimise_all_scans
from sl3d_slam.graph.pose_graph import PoseGraph
from sl3d_slam.graph.world import place_in_world
from sl3d_slam.io.points import checked_points, usable
from sl3d_slam.journal import Journal
from sl3d_slam.keyframes import KeyframeSelector
from sl3d_slam.mapping.line_map import LineMap, MapOrigin
from sl3d_slam.odometry import Odometry
from sl3d_slam.run import Run, StageTimes
from sl3d_slam.types import (
    Keyframe,
    LoopConstraint,
    LoopRecord,
    RegisteredScan,
    Rejection,
    Scan,
    Trajectory,
    WorldMeasurements,
)
from sl3d_slam.viewing import Made, ViewMaker, result_of


class _Opened(NamedTuple):
    """A keyframe whose view is being made; None where it is kept already."""

    id: int
    scan_index: int
    T_odom_lidar: Transform
    view: "Future[Made] | None"


class SlamPipeline:
    """Maps a drive scan by scan.

    Example
    -------
    >>> slam = SlamPipeline(load_config())
    >>> for points in scans:
    ...     slam.process_scan(points)
    >>> run = slam.finish()

    With ``workers`` lines are found in so many other processes while odometry goes on; what comes
    out is the same to the bit. Loops of a keyframe are then known a few scans later. A ``journal``
    that knows the first scans of the drive saves the work on them, not their reading.
    """

    def __init__(
        self,
        config: SlamConfig | None = None,
        simulated: bool = False,
        workers: int = 0,
        journal: Journal | None = None,
    ) -> None:
        """Start with no scan; ``simulated`` labels what comes out."""
        self.config = config or SlamConfig()
        self._simulated = simulated
        self._odometry = Odometry(self.config.odometry, self.config.input)
        self._keyframes = KeyframeSelector(self.config.keyframes)
        self._maker = ViewMaker(self.config, workers)
        self._journal = journal or Journal()
        self._closer = LoopCloser(self.config, self._journal.records)
        self._opened: deque[_Opened] = deque()
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
        points = checked_points(points_lidar, f"scan {index}")
        keep = usable(points, self.config.input, f"scan {index}")
        times = None if stamps is None else _checked_stamps(stamps, len(points), index)[keep]
        if stamp_s is None:
            stamp_s = self._stamps_s[-1] + 0.1 if self._stamps_s else 0.0
        return self.process(Scan(index, stamp_s, np.ascontiguousarray(points[keep]), times))

    def process(self, scan: Scan) -> RegisteredScan:
        """Take the next scan as a reader gives it."""
        index = len(self._stamps_s)
        with self._timed("scan"):
            with self._timed("odometry"):
                registered = self._odometry.register(scan, self._journal.pose(index))
            self._journal.note_scan(index, registered)
            self._stamps_s.append(scan.stamp_s)
            self._T_odom_lidar.append(registered.T_odom_lidar)
            keyframe = self._keyframes.add(registered)
            if keyframe is not None:
                self._open(keyframe, index)
            self._take_up(2 * self._maker.workers)
        return registered

    def finish(
        self, measurements: WorldMeasurements | None = None, covariance: bool = False
    ) -> Run:
        """Optimise over all scans and build the map; the pipeline may not be used afterwards.

        ``measurements`` of other sensors (GPS, gravity) pull the trajectory straight and tell where
        the map lies; ``covariance`` asks for the marginals of every keyframe.
        """
        if not self._stamps_s:
            raise InputError("no scan was given, so there is nothing to map")
        self._take_up(0)
        self._maker.close()
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
            stamps_s = np.array(self._stamps_s)
            world = None
            if measurements:
                odometry = Trajectory(stamps_s, T_odom_lidar)
                world = place_in_world(final, odometry, measurements, self.config.world)
                final = world.graph
        place = None if world is None else world.georeference
        with self._timed("map"):
            line_map = self._build_map(final.T_world_lidar, place)
        self._journal.close()
        keyframe_scans = list(self._scan_of_keyframe.values())
        return Run(
            config=self.config,
            trajectory=Trajectory(stamps_s, final.T_world_lidar),
            odometry=Trajectory(stamps_s, T_odom_lidar),
            loops=self._loop_records(),
            graph_g2o=final.to_g2o(),
            line_map=line_map,
            num_keyframes=len(self._scan_of_keyframe),
            times=self._times,
            world=None if world is None else world.facts(),
            covariances=keyframe_covariances(final, keyframe_scans) if covariance else None,
        )

    def _open(self, keyframe: Keyframe, scan_index: int) -> None:
        """Have the view of a keyframe made, where it is not kept from an interrupted run."""
        kept = self._closer.has_view(keyframe.id)
        view = None if kept else self._maker.start(keyframe.points_lidar)
        self._opened.append(_Opened(keyframe.id, scan_index, keyframe.T_odom_lidar, view))

    def _take_up(self, limit: int) -> None:
        """Go on with the keyframes whose views are made, in order; wait where more are open."""
        while self._opened:
            view = self._opened[0].view
            if len(self._opened) <= limit and not (view is None or view.done()):
                break
            self._extend(self._opened.popleft())

    def _extend(self, keyframe: _Opened) -> None:
        """Add a keyframe to graph and constellations and look for its loops."""
        if keyframe.view is not None:
            packed, seconds = result_of(keyframe.view)
            self._times.add("lines", seconds)
            self._closer.keep(keyframe.id, packed)
        self._closer.add_kept(keyframe.id, keyframe.T_odom_lidar)
        last = self._scan_of_keyframe.get(keyframe.id - 1, keyframe.scan_index)
        self._scan_of_keyframe[keyframe.id] = keyframe.scan_index
        steps = keyframe.scan_index - last
        with self._timed("graph"):
            self._graph.add_keyframe(keyframe.id, keyframe.T_odom_lidar, steps)
        if self.config.loops.enabled:
            self._close_loops(keyframe.id)

    def _close_loops(self, keyframe_id: int) -> None:
        outcomes = self._journal.outcomes(keyframe_id)
        if outcomes is None:
            with self._timed("loops"):
                found = self._closer.search(keyframe_id, self._graph.estimates())
            outcomes = self._journal.note_outcomes(keyframe_id, found)
        for outcome in outcomes:
            if isinstance(outcome, LoopConstraint):
                with self._timed("graph"):
                    self._graph.add_loop(outcome)
            else:
                self._rejections.append(outcome)

    def _build_map(
        self, T_world_lidar: Float64[np.ndarray, "N 4 4"], place: GeoReference | None
    ) -> LineMap:
        keyframes = list(self._scan_of_keyframe)
        lines, up = [], []
        for keyframe_id in keyframes:
            view = self._closer.view(keyframe_id)
            lines.append(view.lines)
            up.append(view.up)
        return LineMap.build(
            lines,
            T_world_lidar[list(self._scan_of_keyframe.values())],
            np.array(up),
            KeptClouds(self._closer, keyframes) if self.config.map.clouds else None,
            self.config.map,
            MapOrigin(
                config=dump_config(self.config), simulated=self._simulated, georeference=place
            ),
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

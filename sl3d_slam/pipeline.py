"""A whole drive: scans in, trajectory, loops, graph and line map out.

``process`` is the order of the stages; each does its work in its own module.
"""

import numpy as np
from jaxtyping import Float64

from sl3d_slam.config import SlamConfig, dump_config
from sl3d_slam.errors import InputError
from sl3d_slam.graph.final import keyframe_covariances, optimise_all_scans
from sl3d_slam.graph.world import place_in_world
from sl3d_slam.io.points import checked_points, usable
from sl3d_slam.journal import Journal
from sl3d_slam.keyframe_work import KeyframeWork
from sl3d_slam.keyframes import KeyframeSelector
from sl3d_slam.mapping.line_map import MapOrigin
from sl3d_slam.odometry.odometry import Odometry
from sl3d_slam.run import Run, StageTimes
from sl3d_slam.types import RegisteredScan, Scan, Trajectory, WorldMeasurements


class SlamPipeline:
    """Maps a drive scan by scan.

    Example
    -------
    >>> slam = SlamPipeline(load_config())
    >>> for points in scans:
    ...     slam.process_scan(points)
    >>> run = slam.finish()

    With ``workers`` lines and loops are found in so many other processes while odometry goes on;
    what comes out is the same to the bit. Loops of a keyframe take effect three keyframes later.
    A ``journal`` that knows the first scans of the drive saves the work on them, not their reading.
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
        self._journal = journal or Journal()
        self._times = StageTimes()
        self._work = KeyframeWork(self.config, workers, self._journal, self._times)
        self._stamps_s: list[float] = []
        self._T_odom_lidar: list[np.ndarray] = []
        self._pose_covariances: list[np.ndarray | None] = []

    @property
    def num_loops(self) -> int:
        """The number of loops accepted now."""
        return len(self._work.graph.accepted_loops)

    @property
    def is_ready(self) -> bool:
        """Whether nothing is left to be loaded or compiled."""
        return self._work.is_ready

    def get_ready(self) -> None:
        """Compile what has not been compiled on this machine yet, for a minute or two.

        Without this the first scans wait for it.
        """
        self._work.get_ready()

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
        return self.process(Scan(index, stamp_s, points.compress(keep, axis=0), times))

    def process(self, scan: Scan) -> RegisteredScan:
        """Take the next scan as a reader gives it."""
        index = len(self._stamps_s)
        with self._times.measured("scan"):
            with self._times.measured("odometry"):
                registered = self._odometry.register(scan, self._journal.pose(index))
            registered = self._journal.note_scan(index, registered)
            self._stamps_s.append(scan.stamp_s)
            self._T_odom_lidar.append(registered.T_odom_lidar)
            self._pose_covariances.append(registered.covariance)
            keyframe = self._keyframes.add(registered)
            if keyframe is not None:
                self._work.open(keyframe, index)
            self._work.go_on()
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
        self._work.finish()
        graph, keyframe_scans = self._work.graph, self._work.scan_of_keyframe
        with self._times.measured("final"):
            graph.settle()
            T_odom_lidar = np.array(self._T_odom_lidar)
            final = optimise_all_scans(
                T_odom_lidar,
                keyframe_scans,
                graph.estimates(),
                graph.accepted_loops,
                self.config.graph,
                self._pose_covariances,
            )
            stamps_s = np.array(self._stamps_s)
            world = None
            if measurements:
                odometry = Trajectory(stamps_s, T_odom_lidar)
                world = place_in_world(final, odometry, measurements, self.config.world)
                final = world.graph
        place = None if world is None else world.georeference
        origin = MapOrigin(
            self._journal.model, dump_config(self.config), self._simulated, georeference=place
        )
        with self._times.measured("map"):
            line_map = self._work.build_map(final.T_world_lidar, origin)
        self._journal.close()
        covered = list(keyframe_scans.values())
        return Run(
            config=self.config,
            trajectory=Trajectory(stamps_s, final.T_world_lidar),
            odometry=Trajectory(stamps_s, T_odom_lidar),
            loops=self._work.loop_records(),
            graph_g2o=final.to_g2o(),
            line_map=line_map,
            num_keyframes=len(keyframe_scans),
            times=self._times,
            workers_peak_mb=self._work.workers_peak_mb,
            world=None if world is None else world.facts(),
            covariances=keyframe_covariances(final, covered) if covariance else None,
        )

    def close(self) -> None:
        """End the workers of a drive that is left unfinished; does nothing after ``finish``."""
        self._work.close()


def _checked_stamps(stamps: np.ndarray, count: int, index: int) -> Float64[np.ndarray, "N"]:
    times = np.asarray(stamps, np.float64)
    if times.shape != (count,) or not np.isfinite(times).all():
        raise InputError(
            f"scan {index}: stamps of shape {times.shape} for {count} points; "
            "expected a finite time in seconds for each point"
        )
    return times

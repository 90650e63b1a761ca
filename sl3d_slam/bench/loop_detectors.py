"""What detects loops in ``bench loops``: the whole pipeline, and MapClosures on local maps."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from sl3d_slam.bench.peers import importing
from sl3d_slam.bench.systems import OURS, OurSystem, point_times_s
from sl3d_slam.config import SlamConfig
from sl3d_slam.errors import InputError
from sl3d_slam.geometry.se3 import Transform, distance_m, invert
from sl3d_slam.types import LoopRecord, Scan

ACCEPTED_BONUS = 1000.0


@dataclass(frozen=True, slots=True, eq=False)
class Detection:
    """A place that was recognised, or proposed and rejected.

    Attributes
    ----------
    query_scans, target_scans : first scan and the one after the last that each side was made of.
    query_frame, target_frame : scans in whose lidar frames ``T_target_query`` is given.
    score : higher is surer; only its order counts.
    accepted : whether the detector itself stands by it.
    """

    query_scans: tuple[int, int]
    target_scans: tuple[int, int]
    query_frame: int
    target_frame: int
    T_target_query: Transform
    score: float
    accepted: bool


def detect(name: str, config: SlamConfig, scans: Iterable[Scan]) -> list[Detection]:
    """Run one detector over a drive.

    Raises
    ------
    MissingExtraError
        where the peer is not installed, saying how to install it.
    InputError
        where there is no such detector.
    """
    if name == OURS:
        return our_loops(config, scans)
    if name == "map-closures":
        return map_closures(scans)
    raise InputError(f"{name}: unknown detector; expected {', '.join(PEERS)}")


PEERS = ("map-closures",)


def our_loops(config: SlamConfig, scans: Iterable[Scan]) -> list[Detection]:
    """Return every candidate that this package's pipeline verified on its way."""
    system = OurSystem(config)
    for scan in scans:
        system.process(scan)
    return [as_detection(record) for record in system.finish()().loops]


def as_detection(record: LoopRecord) -> Detection:
    """Present a verified candidate as a detection; accepted ones outrank all others."""
    accepted = record.status == "accepted"
    return Detection(
        query_scans=(record.query_scan, record.query_scan + 1),
        target_scans=(record.target_scan, record.target_scan + 1),
        query_frame=record.query_scan,
        target_frame=record.target_scan,
        T_target_query=record.T_target_query,
        score=record.num_inliers + ACCEPTED_BONUS * accepted,
        accepted=accepted,
    )


def map_closures(scans: Iterable[Scan]) -> list[Detection]:
    """Return what MapClosures (Gupta et al., ICRA 2024) finds between local maps of 100 m.

    Local maps are made from KISS-ICP's poses and handed over in the way and with the settings of
    its own pipeline; every closure that it reports is kept with its number of inliers as the score.
    """
    maker = _LocalMaps()
    found: list[Detection] = []
    for scan in scans:
        if maker.add(scan):
            found += maker.close()
    return found + maker.close()


class _LocalMaps:
    """Local maps of a drive, one after the other, and the closures between them."""

    def __init__(self) -> None:
        with importing("map-closures"):
            from kiss_icp.config import KISSConfig
            from kiss_icp.kiss_icp import KissICP
            from map_closures.config import MapClosuresConfig
            from map_closures.map_closures import MapClosures
            from map_closures.voxel_map import VoxelMap
        settings = KISSConfig()
        settings.mapping.voxel_size = 1.0
        settings.data.max_range = 100.0
        self._range_m = settings.data.max_range
        self._settings = MapClosuresConfig()
        self._odometry = KissICP(settings)
        self._closures = MapClosures(self._settings)
        self._points = VoxelMap(self._settings.density_map_resolution, self._range_m)
        self._T_odom_map: Transform = np.eye(4)
        self._starts = [0]
        self._stops: list[int] = []
        self._last = -1

    def add(self, scan: Scan) -> bool:
        """Take a scan; tell whether the local map has become long enough."""
        points, _ = self._odometry.register_frame(scan.points_lidar, point_times_s(scan))
        T_map_lidar = invert(self._T_odom_map) @ self._odometry.last_pose
        self._points.integrate_frame(points, T_map_lidar)
        self._last = scan.index
        return distance_m(T_map_lidar) > self._range_m

    def close(self) -> list[Detection]:
        """Look for the present local map among those before it, and start the next one."""
        if self._starts[-1] == self._last:
            return []
        number = len(self._stops)
        self._stops.append(self._last + 1)
        answers = self._closures.get_closures(number, self._points.point_cloud())
        self._start_next()
        return [self._of_closure(answer) for answer in answers]

    def _start_next(self) -> None:
        """Keep what is near in the frame of the last scan, as MapClosures' pipeline does."""
        T_map_lidar = invert(self._T_odom_map) @ self._odometry.last_pose
        self._points.remove_far_away_points(T_map_lidar[:3, 3])
        kept = self._points.point_cloud()
        self._points.clear()
        self._points.integrate_frame(kept, invert(T_map_lidar))
        self._T_odom_map = self._odometry.last_pose.copy()
        self._starts.append(self._last)

    def _of_closure(self, answer: Any) -> Detection:
        """Express a closure, whose pose takes the older map ``source`` to the newer ``target``."""
        older, newer = int(answer.source_id), int(answer.target_id)
        return Detection(
            query_scans=(self._starts[newer], self._stops[newer]),
            target_scans=(self._starts[older], self._stops[older]),
            query_frame=self._starts[newer],
            target_frame=self._starts[older],
            T_target_query=invert(np.array(answer.pose, np.float64)),
            score=float(answer.number_of_inliers),
            accepted=int(answer.number_of_inliers) > self._settings.inliers_threshold,
        )

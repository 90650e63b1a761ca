"""The SLAM systems that ``bench slam`` compares, behind one interface.

The peers get exactly the points that this package's reader gives, and their own default settings.
"""

import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float64

from sl3d_slam.bench.peers import importing
from sl3d_slam.config import SlamConfig
from sl3d_slam.errors import InputError
from sl3d_slam.geometry.se3 import Transform, invert
from sl3d_slam.types import LoopRecord, Scan

OURS = "sl3d-slam"


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """What a system has at the end; ``map_bytes`` None where it leaves no map."""

    T_world_lidar: Float64[np.ndarray, "N 4 4"]
    loops: list[LoopRecord] = field(default_factory=list)
    map_bytes: int | None = None


@runtime_checkable
class System(Protocol):
    """A SLAM system: scans one by one, then the outcome."""

    def process(self, scan: Scan) -> None:
        """Take the next scan."""

    def finish(self) -> Callable[[], Outcome]:
        """Do what remains to be done; what comes back only collects (not timed)."""


class OurSystem:
    """The whole pipeline of this package."""

    def __init__(self, config: SlamConfig) -> None:
        from sl3d_slam.beside import default_workers
        from sl3d_slam.pipeline import SlamPipeline

        self._slam = SlamPipeline(config, workers=default_workers())
        self._slam.get_ready()

    def process(self, scan: Scan) -> None:
        """Take the next scan."""
        self._slam.process(scan)

    def finish(self) -> Callable[[], Outcome]:
        """Optimise over all scans and build the line map."""
        run = self._slam.finish()
        return lambda: Outcome(
            run.trajectory.T_world_lidar, run.loops, len(run.line_map.to_bytes())
        )


class KissIcpSystem:
    """KISS-ICP alone (Vizzo et al., RA-L 2023): odometry, no loops, no map kept."""

    def __init__(self) -> None:
        with importing("kiss-icp"):
            from kiss_icp.config.parser import load_config
            from kiss_icp.kiss_icp import KissICP
        self._odometry = KissICP(load_config(None))
        self._poses: list[Transform] = []

    def process(self, scan: Scan) -> None:
        """Take the next scan."""
        self._odometry.register_frame(scan.points_lidar, point_times_s(scan))
        self._poses.append(self._odometry.last_pose.copy())

    def finish(self) -> Callable[[], Outcome]:
        """Nothing remains to be done."""
        return lambda: Outcome(np.array(self._poses))


class KissSlamSystem:
    """kiss-slam (Guadagnino et al., 2025): KISS-ICP, MapClosures, a graph of local maps."""

    def __init__(self) -> None:
        with importing("kiss-slam"):
            from kiss_slam.config import load_config
            from kiss_slam.slam import KissSLAM
        self._slam = KissSLAM(load_config(None))
        self._first_scan_of_map = {0: 0}
        self._verdicts: list[tuple[int, int, Transform, bool]] = []
        self._compute = self._slam.closer.compute
        self._slam.closer.compute = self._compute_and_note

    def process(self, scan: Scan) -> None:
        """Take the next scan; the scan that ends a local map is the frame of the one after."""
        self._slam.process_scan(scan.points_lidar, point_times_s(scan))
        self._first_scan_of_map.setdefault(int(self._slam.local_map_graph.last_id), scan.index)

    def finish(self) -> Callable[[], Outcome]:
        """Close the last local map and optimise over all scans, as kiss-slam's pipeline does."""
        self._slam.generate_new_node()
        self._slam.local_map_graph.erase_last_local_map()
        poses, _ = self._slam.fine_grained_optimization()
        return lambda: Outcome(np.array(poses), self._loops(), self._map_bytes())

    def _compute_and_note(self, query_id: int, points: Any, graph: Any) -> Any:
        answer = self._compute(query_id, points, graph)
        is_good, target_id, _, T_query_target = answer
        if target_id >= 0:
            verdict = (query_id, target_id, np.array(T_query_target), bool(is_good))
            self._verdicts.append(verdict)
        return answer

    def _loops(self) -> list[LoopRecord]:
        """Express each closure as one between the scans in whose frames the local maps lie."""
        return [
            LoopRecord(
                query_scan=self._first_scan_of_map[query_id],
                target_scan=self._first_scan_of_map[target_id],
                T_target_query=invert(T_query_target),
                num_inliers=0,
                status="accepted" if is_good else "rejected",
                reason="" if is_good else "the local maps overlap too little",
            )
            for query_id, target_id, T_query_target, is_good in self._verdicts
        ]

    def _map_bytes(self) -> int:
        """Return the size of the local maps as kiss-slam writes them."""
        with tempfile.TemporaryDirectory() as folder:
            for local_map in self._slam.local_map_graph.local_maps():
                local_map.write(str(Path(folder) / f"{local_map.id:06d}.ply"))
            return sum(path.stat().st_size for path in Path(folder).iterdir())


PEERS: dict[str, Callable[[], System]] = {"kiss-slam": KissSlamSystem, "kiss-icp": KissIcpSystem}


def make_system(name: str, config: SlamConfig) -> System:
    """Return a system that has seen no scan.

    Raises
    ------
    MissingExtraError
        where a peer is not installed, saying how to install it.
    InputError
        where there is no such system.
    """
    if name == OURS:
        return OurSystem(config)
    if name not in PEERS:
        raise InputError(f"{name}: unknown system; expected {', '.join(PEERS)}")
    return PEERS[name]()


def point_times_s(scan: Scan) -> Float64[np.ndarray, "M"]:
    """Return point times that KISS-ICP's deskewing can bear: it aborts where all are equal."""
    times_s = scan.point_times_s
    if times_s is None or np.ptp(times_s) <= 0.0:
        return np.empty(0)
    return times_s

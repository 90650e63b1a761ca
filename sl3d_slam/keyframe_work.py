"""All that follows from a keyframe: its view, its place in the graph, its loops, its map lines."""

import time
from collections import deque
from concurrent.futures import Future
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from sl3d_slam.beside import Beside, result_of
from sl3d_slam.closing import KeptClouds, LoopCloser
from sl3d_slam.config import SlamConfig
from sl3d_slam.geometry.se3 import Transform
from sl3d_slam.graph.pose_graph import PoseGraph
from sl3d_slam.journal import Journal
from sl3d_slam.loops.triangle_table import must_compile
from sl3d_slam.mapping.line_map import LineMap, MapOrigin
from sl3d_slam.memory import keep_large_arrays_apart
from sl3d_slam.rehearsal import rehearse_constellations
from sl3d_slam.run import StageTimes
from sl3d_slam.types import Keyframe, LoopConstraint, LoopRecord, Rejection
from sl3d_slam.worker import Made, Verified

# keyframes from a search to its effect, so that it may be done beside odometry: with two views in
# the queue before it, it is over when the third one's is made
LAG = 3
OPEN_AT_START = 24  # keyframes while the workers start, about 2 MB each


class _Opened(NamedTuple):
    """A keyframe whose view is being made; None where it is kept already."""

    id: int
    scan_index: int
    T_odom_lidar: Transform
    view: "Future[Made] | None"


class _Searched(NamedTuple):
    """A keyframe whose candidates are being verified; None where the journal knows the outcome.

    ``seconds`` is what finding the candidates took.
    """

    id: int
    verified: "Future[Verified] | None"
    seconds: float = 0.0


class KeyframeWork:
    """Keyframes in their order; with a worker views are made and candidates verified beside.

    What becomes of a keyframe's candidates takes effect when the keyframe ``LAG`` later is taken
    up, however long it took, so that a run is the same with and without workers.

    Attributes
    ----------
    graph : the live pose graph of the keyframes taken up so far.
    scan_of_keyframe : the scan that each of them is.
    """

    def __init__(
        self, config: SlamConfig, workers: int, journal: Journal, times: StageTimes
    ) -> None:
        self.graph = PoseGraph(config.graph)
        self.scan_of_keyframe: dict[int, int] = {}
        self._config = config
        self._beside = Beside(config, workers)
        self._journal = journal
        self._closer = LoopCloser(config, self.graph.chain, journal.records)
        self._opened: deque[_Opened] = deque()
        self._searched: deque[_Searched] = deque()
        self._rejections: list[Rejection] = []
        self._times = times
        self._open_limit = OPEN_AT_START

    @property
    def is_ready(self) -> bool:
        """Whether nothing is left to be loaded or compiled."""
        return self._beside.is_ready

    @property
    def workers_peak_mb(self) -> float:
        """The most memory that the workers held of their own, once they have ended."""
        return self._beside.workers_peak_mb

    def get_ready(self) -> None:
        """Compile what a first run on a machine must compile, and load it."""
        keep_large_arrays_apart()
        if must_compile():
            self._beside.compile()
        rehearse_constellations()
        self._beside.start()

    def open(self, keyframe: Keyframe, scan_index: int) -> None:
        """Have the view of a keyframe made, where it is not kept from an interrupted run."""
        kept = self._closer.has_view(keyframe.id)
        view = None if kept else self._beside.make_view(keyframe.points_lidar)
        self._opened.append(_Opened(keyframe.id, scan_index, keyframe.T_odom_lidar, view))

    def go_on(self) -> None:
        """Take up the keyframes whose views are made; wait where more than a few are open.

        Those that the start left open are waited for one a scan, so that no scan waits for all.
        """
        if self._beside.workers == 0 or self._beside.is_ready:
            self._open_limit = max(self._open_limit - 1, 2 * self._beside.workers)
        self._take_up(self._open_limit)

    def finish(self) -> None:
        """Take up all that are open, let all searches take effect and end the workers."""
        self._take_up(0)
        self._conclude(0)
        self.close()

    def close(self) -> None:
        """End the workers; what they had not begun is dropped."""
        self._beside.close()

    def build_map(self, T_world_lidar: Float64[np.ndarray, "N 4 4"], origin: MapOrigin) -> LineMap:
        """Merge the lines of all keyframes, given the final pose of every scan."""
        keyframes = list(self.scan_of_keyframe)
        lines, up = [], []
        for keyframe_id in keyframes:
            view = self._closer.view(keyframe_id)
            lines.append(view.lines)
            up.append(view.up)
        return LineMap.build(
            lines,
            T_world_lidar[list(self.scan_of_keyframe.values())],
            np.array(up),
            KeptClouds(self._closer, keyframes) if self._config.map.clouds else None,
            self._config.map,
            origin,
        )

    def loop_records(self) -> list[LoopRecord]:
        """Return every verified candidate with what became of it, by scan."""
        records = [
            self._record(verdict.loop, verdict.status, verdict.reason)
            for verdict in self.graph.verdicts
        ]
        records += [self._record(no, "rejected", no.reason) for no in self._rejections]
        return sorted(records, key=lambda record: (record.query_scan, record.target_scan))

    def _take_up(self, limit: int) -> None:
        while self._opened and (len(self._opened) > limit or self._next_is_ready()):
            self._extend(self._opened.popleft())

    def _next_is_ready(self) -> bool:
        """Tell whether the next keyframe can be taken up without waiting."""
        view = self._opened[0].view
        needed = self._searched[0].verified if len(self._searched) == LAG else None
        return all(future is None or future.done() for future in (view, needed))

    def _extend(self, keyframe: _Opened) -> None:
        """Add a keyframe to graph and constellations and look for its loops."""
        if keyframe.view is not None:
            made = result_of(keyframe.view)
            self._times.add("lines", made.seconds)
            self._journal.note_model(made.model)
            self._closer.keep(keyframe.id, made.packed)
        self._conclude(LAG - 1)
        self._closer.add_kept(keyframe.id, keyframe.T_odom_lidar)
        last = self.scan_of_keyframe.get(keyframe.id - 1, keyframe.scan_index)
        self.scan_of_keyframe[keyframe.id] = keyframe.scan_index
        steps = keyframe.scan_index - last
        with self._times.measured("graph"):
            self.graph.add_keyframe(keyframe.id, keyframe.T_odom_lidar, steps)
        if self._config.loops.enabled:
            self._searched.append(self._search(keyframe.id))

    def _search(self, keyframe_id: int) -> _Searched:
        if self._journal.outcomes(keyframe_id) is not None:
            return _Searched(keyframe_id, None)
        start_s = time.perf_counter()
        candidates = self._closer.candidates(keyframe_id, self.graph.estimates())
        taken_s = time.perf_counter() - start_s
        return _Searched(keyframe_id, self._beside.verify(candidates), taken_s)

    def _conclude(self, limit: int) -> None:
        """Let the oldest searches take effect, until so many are left."""
        while len(self._searched) > limit:
            for outcome in self._outcomes(self._searched.popleft()):
                if isinstance(outcome, LoopConstraint):
                    with self._times.measured("graph"):
                        self.graph.add_loop(outcome)
                else:
                    self._rejections.append(outcome)

    def _outcomes(self, searched: _Searched) -> list[LoopConstraint | Rejection]:
        if searched.verified is None:
            return self._journal.outcomes(searched.id) or []
        verified = result_of(searched.verified)
        self._times.add("loops", searched.seconds + verified.seconds)
        return self._journal.note_outcomes(searched.id, verified.outcomes)

    def _record(
        self, candidate: LoopConstraint | Rejection, status: str, reason: str
    ) -> LoopRecord:
        T_target_query = candidate.T_target_query
        assert T_target_query is not None  # every verified candidate has a pose
        return LoopRecord(
            self.scan_of_keyframe[candidate.query_id],
            self.scan_of_keyframe[candidate.target_id],
            T_target_query,
            candidate.num_inliers,
            status,
            "" if status == "accepted" else reason,
        )

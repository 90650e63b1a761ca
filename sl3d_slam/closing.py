"""Closing loops: remember every keyframe's view, propose earlier ones, verify, answer.

The pipeline and the plugin run this same stage; who owns the graph makes no difference to it.
"""

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import overload

import numpy as np
from jaxtyping import Float32

from sl3d_slam.config import SlamConfig
from sl3d_slam.geometry.se3 import Points, Transform, distance_m, invert
from sl3d_slam.graph.chain import OdometryChain
from sl3d_slam.lines.extract import LineExtractor
from sl3d_slam.loops.candidates import is_worth_a_loop, nearest_by_estimate, thin_votes
from sl3d_slam.loops.constellations import ConstellationIndex, PlaceVote
from sl3d_slam.matching.prepared import PreparedView
from sl3d_slam.matching.verticals import Verticals
from sl3d_slam.matching.views import from_bytes, pack, to_bytes, unpack
from sl3d_slam.records import RecordFile
from sl3d_slam.types import LoopConstraint, Rejection, View
from sl3d_slam.verifying import Candidates, verify
from sl3d_slam.viewing import view_of

NUM_VOTED = 30  # views that constellations may vote for, before those of one place are thinned


class LoopCloser:
    """Views of all keyframes, kept in a file, and the constellations in them.

    ``add`` remembers a keyframe, ``search`` looks for loops to earlier ones: it proposes candidates
    and verifies them.
    """

    def __init__(
        self, config: SlamConfig, chain: OdometryChain, records: RecordFile | None = None
    ) -> None:
        """Keep views in ``records``, or in a temporary file.

        ``chain`` holds every keyframe before loops are searched from it: how far odometry may have
        drifted decides how far apart the views of a loop may be.
        """
        self._config = config
        self._chain = chain
        self._index = ConstellationIndex()
        self._records = RecordFile.temporary() if records is None else records
        self._travelled_m: dict[int, float] = {}
        self._T_odom_last: Transform | None = None
        self._verticals_of_last: tuple[int, Verticals] | None = None  # to be asked for

    @cached_property
    def _extractor(self) -> LineExtractor:
        return LineExtractor(self._config.lines)

    def has_view(self, keyframe_id: int) -> bool:
        """Tell whether the view of a keyframe is kept already."""
        return _name(keyframe_id) in self._records

    def view(self, keyframe_id: int) -> View:
        """Return what was kept of a keyframe, in its lidar frame."""
        return unpack(from_bytes(self._records[_name(keyframe_id)]))

    def make_view(self, points_lidar: Points) -> View:
        """Extract what loops need from a scan."""
        return view_of(points_lidar, self._extractor, self._config)

    def add(self, keyframe_id: int, view: View, T_odom_lidar: Transform) -> None:
        """Remember a keyframe; ids grow, and odometry tells how far it is from the last one."""
        self.keep(keyframe_id, to_bytes(pack(view)))
        self.add_kept(keyframe_id, T_odom_lidar)

    def keep(self, keyframe_id: int, packed: bytes) -> None:
        """Keep the view of a keyframe, packed as bytes."""
        self._records[_name(keyframe_id)] = packed

    def add_kept(self, keyframe_id: int, T_odom_lidar: Transform) -> None:
        """Remember a keyframe whose view is kept."""
        travelled = 0.0
        if self._T_odom_last is not None:
            step_m = distance_m(invert(self._T_odom_last) @ T_odom_lidar)
            travelled = next(reversed(self._travelled_m.values())) + step_m
        self._travelled_m[keyframe_id] = travelled
        self._T_odom_last = T_odom_lidar
        verticals = self._verticals(keyframe_id)
        self._index.add(keyframe_id, verticals.xy, verticals.weights)

    def search(
        self, query_id: int, estimates: Mapping[int, Transform]
    ) -> list[LoopConstraint | Rejection]:
        """Look for loops from a keyframe to those before it; one answer a verified candidate.

        Parameters
        ----------
        query_id : a keyframe that was added.
        estimates : the best present ``T_world_lidar`` of keyframes; they add candidates, but
            constellations find revisits wherever the estimates have drifted to.
        """
        candidates = self.candidates(query_id, estimates)
        return verify(candidates, self._config) if len(candidates) else []

    def candidates(self, query_id: int, estimates: Mapping[int, Transform]) -> Candidates:
        """Return what :meth:`search` verifies."""
        newest_id = self._newest_far_id(query_id)
        if newest_id is None:
            return Candidates(query_id, (), None, {})
        settings, verticals = self._config.loops, self._verticals(query_id)
        votes = self._index.query(verticals.xy, verticals.weights, newest_id, NUM_VOTED)
        by_lines = [
            (vote.view_id, vote.pose)
            for vote in thin_votes(votes, self._travelled_m, settings)
            if self._is_worth_it(query_id, vote)
        ]
        nearest = None
        if query_id in estimates:
            nearest = nearest_by_estimate(
                query_id, newest_id, estimates, self._travelled_m, settings
            )
        by_estimate = None if nearest is None else (nearest.view_id, nearest.T_view_query)
        ids = [query_id, *(target_id for target_id, _ in by_lines)]
        ids += [] if nearest is None else [nearest.view_id]
        packed = {keyframe_id: self._records[_name(keyframe_id)] for keyframe_id in ids}
        return Candidates(query_id, by_lines, by_estimate, packed)

    def _newest_far_id(self, query_id: int) -> int | None:
        limit = self._travelled_m[query_id] - self._config.loops.min_travel_m
        far = [k for k, travelled in self._travelled_m.items() if travelled < limit]
        return far[-1] if far else None

    def _is_worth_it(self, query_id: int, vote: PlaceVote) -> bool:
        drift_m = self._chain.drift_m(vote.view_id, query_id)
        return is_worth_a_loop(float(np.hypot(*vote.pose[1:])), drift_m, self._config.loops)

    def _verticals(self, keyframe_id: int) -> Verticals:
        if self._verticals_of_last is None or self._verticals_of_last[0] != keyframe_id:
            view = PreparedView(self.view(keyframe_id), self._config.matching)
            self._verticals_of_last = keyframe_id, view.verticals
        return self._verticals_of_last[1]


class KeptClouds(Sequence[Float32[np.ndarray, "N 3"]]):
    """The coarse clouds of keyframes, each read from the file when it is asked for."""

    def __init__(self, closer: LoopCloser, keyframe_ids: Sequence[int]) -> None:
        self._closer, self._ids = closer, keyframe_ids

    def __len__(self) -> int:
        """Return the number of clouds."""
        return len(self._ids)

    @overload
    def __getitem__(self, index: int) -> Float32[np.ndarray, "N 3"]: ...
    @overload
    def __getitem__(self, index: slice) -> "KeptClouds": ...
    def __getitem__(self, index: int | slice) -> "Float32[np.ndarray, 'N 3'] | KeptClouds":
        """Read one cloud; a slice reads none yet."""
        if isinstance(index, slice):
            return KeptClouds(self._closer, self._ids[index])
        return self._closer.view(self._ids[index]).cloud


def _name(keyframe_id: int) -> str:
    return f"view {keyframe_id}"

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
from sl3d_slam.lines.extract import LineExtractor
from sl3d_slam.loops.candidates import nearest_by_estimate, thin_votes
from sl3d_slam.loops.constellations import ConstellationIndex
from sl3d_slam.matching.judge import gather_evidence, objection
from sl3d_slam.matching.prepared import PreparedView, lift
from sl3d_slam.matching.views import from_bytes, pack, to_bytes, unpack
from sl3d_slam.records import RecordFile
from sl3d_slam.registration import field_agreement
from sl3d_slam.types import LoopConstraint, Rejection, View
from sl3d_slam.viewing import view_of

CACHE_SIZE = 8  # of about 4 MB; a search needs two


class LoopCloser:
    """Views of all keyframes, kept in a file, and the constellations in them.

    ``add`` remembers a keyframe, ``search`` looks for loops to earlier ones.
    """

    def __init__(self, config: SlamConfig, records: RecordFile | None = None) -> None:
        """Keep views in ``records``, or in a temporary file."""
        self._config = config
        self._index = ConstellationIndex()
        self._records = RecordFile.temporary() if records is None else records
        self._cache: dict[int, PreparedView] = {}
        self._travelled_m: dict[int, float] = {}
        self._T_odom_last: Transform | None = None

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
        verticals = self._prepared(keyframe_id).verticals
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
        newest_id = self._newest_far_id(query_id)
        if newest_id is None:
            return []
        guesses = self._guesses(query_id, newest_id, estimates)
        return [self._verify(query_id, target_id, T) for target_id, T in guesses.items()]

    def _newest_far_id(self, query_id: int) -> int | None:
        limit = self._travelled_m[query_id] - self._config.loops.min_travel_m
        far = [k for k, travelled in self._travelled_m.items() if travelled < limit]
        return far[-1] if far else None

    def _guesses(
        self, query_id: int, newest_id: int, estimates: Mapping[int, Transform]
    ) -> dict[int, Transform]:
        """Return first guesses ``T_target_query`` by target; by estimate where no line votes."""
        settings = self._config.loops
        query = self._prepared(query_id)
        verticals = query.verticals
        votes = self._index.query(verticals.xy, verticals.weights, newest_id, 30)
        guesses: dict[int, Transform] = {}
        for vote in thin_votes(votes, self._travelled_m, settings):
            target, pose = self._prepared(vote.view_id), np.array(vote.pose)
            if np.hypot(*pose[1:]) > settings.max_distance_m:
                continue
            if field_agreement(query, target, pose[None])[0] > settings.min_field_agreement:
                guesses[vote.view_id] = lift(query, target, pose)
        if not guesses and query_id in estimates:
            nearby = nearest_by_estimate(
                query_id, newest_id, estimates, self._travelled_m, settings
            )
            if nearby is not None:
                guesses[nearby.view_id] = nearby.T_view_query
        return guesses

    def _verify(
        self, query_id: int, target_id: int, T_guess: Transform
    ) -> LoopConstraint | Rejection:
        query, target = self._prepared(query_id), self._prepared(target_id)
        evidence = gather_evidence(query, target, T_guess, self._config.matching)
        if evidence is None:
            reason = "a scan has too few points to verify a loop with"
            return Rejection(target_id, query_id, reason, T_guess)
        reason = objection(evidence, self._config.matching)
        if reason:
            return Rejection(
                target_id, query_id, reason, evidence.T_target_source, len(evidence.matches)
            )
        return LoopConstraint(
            target_id,
            query_id,
            evidence.T_target_source,
            evidence.information,
            len(evidence.matches),
        )

    def _prepared(self, keyframe_id: int) -> PreparedView:
        """Return a keyframe ready for matching; the last few used are kept."""
        found = self._cache.pop(keyframe_id, None)
        if found is None:
            found = PreparedView(self.view(keyframe_id), self._config.matching)
        self._cache[keyframe_id] = found
        if len(self._cache) > CACHE_SIZE:
            del self._cache[next(iter(self._cache))]
        return found


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

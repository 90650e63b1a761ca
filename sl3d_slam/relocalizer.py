"""Where in a saved line map is this scan? One scan, no first guess, a reasoned no."""

from dataclasses import dataclass

import numpy as np

from sl3d_slam.config import SlamConfig
from sl3d_slam.errors import InputError
from sl3d_slam.geometry.se3 import Transform, distance_m, invert, rotation_angle_rad
from sl3d_slam.lines.extract import LineExtractor
from sl3d_slam.loops.constellations import ConstellationIndex, PlaceVote
from sl3d_slam.mapping.line_map import LineMap
from sl3d_slam.mapping.places import choose_places, place_frame, place_view
from sl3d_slam.matching.judge import Evidence, gather_evidence, objection
from sl3d_slam.matching.prepared import PreparedView, lift
from sl3d_slam.matching.views import make_view
from sl3d_slam.registration import field_agreement
from sl3d_slam.types import Relocalization

NUM_VOTES = 24
NUM_REFINED = 4
SAME_POSE_M = 2.0
SAME_POSE_RAD = np.radians(8.0)
MIN_LEAD = 2.0  # in log odds, over any other place of the map
MAP_BIAS = -2.5  # log odds in a map at which right and wrong are equally likely
CACHE_SIZE = 64


@dataclass(frozen=True, slots=True, eq=False)
class _Found:
    """One place's refined answer."""

    T_map_lidar: Transform
    evidence: Evidence


class Relocalizer:
    """Finds single scans in a line map.

    The map needs its verification cloud (``map.clouds``): lines alone cannot tell one row of lamps
    from the next.
    """

    def __init__(
        self,
        line_map: LineMap,
        config: SlamConfig | None = None,
        extractor: LineExtractor | None = None,
    ) -> None:
        """Index a map. Raises InputError where it holds nothing to be found by."""
        if len(line_map) == 0 or line_map.cloud is None:
            raise InputError("the map has no landmarks or no cloud; map again with map.clouds true")
        self._map = line_map
        self._config = config or SlamConfig()
        needed = self._config.relocalization.model_dump()
        self._judging = self._config.matching.model_copy(update=needed)
        self._extractor = extractor or LineExtractor(self._config.lines)
        self._prepared: dict[int, PreparedView] = {}
        self._index = ConstellationIndex()
        self._places = choose_places(line_map)
        for keyframe in self._places:
            verticals = self._place(int(keyframe)).verticals
            self._index.add(int(keyframe), verticals.xy, verticals.weights)

    def relocalize(self, points_lidar: np.ndarray) -> Relocalization:
        """Find the pose of a scan (N, 3), metres in the lidar frame, in the map.

        Returns
        -------
        Relocalization; ``success=False`` carries a reason and no pose.

        Raises
        ------
        InputError
            where the points are no (N, 3) of finite floats, or fewer than 50.
        """
        lines = self._extractor.extract(points_lidar)
        view = make_view(
            np.asarray(points_lidar, np.float64), lines, self._config.matching.cloud_voxel_m
        )
        query = PreparedView(view, self._config.matching)
        verticals = query.verticals
        votes = self._index.query(verticals.xy, verticals.weights, int(self._places[-1]), NUM_VOTES)
        if not votes:
            return _no(f"no constellation of the map fits the {len(verticals)} standing lines")
        return self._decide(self._refine_best(query, votes))

    def _refine_best(self, query: PreparedView, votes: list[PlaceVote]) -> list[_Found]:
        """Refine the guesses that the bird's-eye fields like best, one a pose in the map."""
        guesses: list[tuple[float, PlaceVote, Transform]] = []
        for vote in votes:
            place, pose = self._place(vote.view_id), np.array(vote.pose)
            score = float(field_agreement(query, place, pose[None])[0]) + 0.02 * vote.votes
            guesses.append((score, vote, lift(query, place, pose)))
        found: list[_Found] = []
        tried: list[Transform] = []
        for _, vote, T_place_lidar in sorted(guesses, key=lambda guess: -guess[0]):
            T_map_place = place_frame(self._map, vote.view_id)
            if len(tried) == NUM_REFINED or _among(T_map_place @ T_place_lidar, tried):
                continue
            tried.append(T_map_place @ T_place_lidar)
            evidence = gather_evidence(
                query, self._place(vote.view_id), T_place_lidar, self._config.matching
            )
            if evidence is not None:
                found.append(_Found(T_map_place @ evidence.T_target_source, evidence))
        return sorted(found, key=lambda one: -one.evidence.log_odds)

    def _decide(self, found: list[_Found]) -> Relocalization:
        if not found:
            return _no("the scan has too few points to verify a place with")
        best = found[0]
        reason = objection(best.evidence, self._judging)
        if reason:
            return _no(reason)
        others = [one for one in found if not _among(one.T_map_lidar, [best.T_map_lidar])]
        lead = best.evidence.log_odds - max(
            (one.evidence.log_odds for one in others), default=-np.inf
        )
        if lead < MIN_LEAD:
            return _no("two places of the map fit the scan about equally well")
        return Relocalization(
            success=True,
            T_map_lidar=best.T_map_lidar,
            information=best.evidence.information,
            num_inliers=len(best.evidence.matches),
            confidence=confidence(best.evidence.log_odds, float(lead)),
        )

    def _place(self, keyframe: int) -> PreparedView:
        found = self._prepared.pop(keyframe, None)
        if found is None:
            found = PreparedView(place_view(self._map, keyframe), self._config.matching)
        self._prepared[keyframe] = found
        if len(self._prepared) > CACHE_SIZE:
            del self._prepared[next(iter(self._prepared))]
        return found


def confidence(log_odds: float, lead: float) -> float:
    """Return how far an answer may be trusted, in [0, 1]: its odds, and its lead over the next.

    Against the map of a simulated drive the right places of 46 scans of two days had log odds
    above -0.5, the wrong ones below -4.5.
    """
    right = 1.0 / (1.0 + np.exp(MAP_BIAS - log_odds))
    alone = 1.0 / (1.0 + np.exp(-lead))
    return float(right * alone)


def _among(T_map_lidar: Transform, others: list[Transform]) -> bool:
    for other in others:
        T_difference = invert(other) @ T_map_lidar
        if (
            distance_m(T_difference) < SAME_POSE_M
            and rotation_angle_rad(T_difference) < SAME_POSE_RAD
        ):
            return True
    return False


def _no(reason: str) -> Relocalization:
    return Relocalization(False, None, np.zeros((6, 6)), 0, 0.0, reason)

"""Where in a line map is a view? Lines guess, clouds decide, and a second place as good is a no."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sl3d_slam.config import SlamConfig
from sl3d_slam.errors import InputError
from sl3d_slam.geometry.se3 import Transform, distance_m, invert, rotation_angle_rad
from sl3d_slam.mapping.line_map import LineMap
from sl3d_slam.mapping.places import Places
from sl3d_slam.matching.dense import DenseCloud, prepare
from sl3d_slam.matching.judge import Evidence, gather_near, objection
from sl3d_slam.matching.prepared import PreparedView, flatten, lift
from sl3d_slam.matching.refine import fit_planar
from sl3d_slam.matching.seeds import LINE_VOTE, field_agreement
from sl3d_slam.relocalization.retrieval import MapGuess, MapRetrieval
from sl3d_slam.types import Relocalization, View

NUM_GUESSES = 6
NUM_REFINED = 3
SAME_POSE_M = 2.0
SAME_POSE_RAD = np.radians(8.0)
MIN_LEAD = 2.0  # in log odds, over any other place of the map
CONFIDENCE_SLOPE, CONFIDENCE_BIAS = 0.52, 1.0  # see confidence
# of both fields' mean values: 44 right guesses reached 1.14 and more, 76 wrong ones 0.63 at most
MIN_FIELD = 0.6
RIVAL_SHARE = 0.7  # of the best guess's score, above which another is refined in any case
CACHE_SIZE = 64
DENSE_RADIUS_M = 45.0  # of a place that a scan is aligned with: half of the cost, the same pose


class _Place:
    """A place's view, and its cloud near enough to hold a scan by, each made when first needed."""

    def __init__(self, prepared: PreparedView) -> None:
        self.prepared = prepared

    @cached_property
    def dense(self) -> DenseCloud | None:
        cloud = self.prepared.view.cloud
        return prepare(cloud[np.hypot(cloud[:, 0], cloud[:, 1]) < DENSE_RADIUS_M])


@dataclass(frozen=True, slots=True, eq=False)
class _Found:
    """One place's refined answer."""

    T_map_lidar: Transform
    keyframe: int
    evidence: Evidence


@dataclass(frozen=True, slots=True, eq=False)
class MapAnswer:
    """An answer, and the keyframe of the place that it was verified against; -1 without one."""

    relocalization: Relocalization
    keyframe: int


class MapFinder:
    """Finds views in a line map; no extractor, so that a place of another map may be asked too."""

    def __init__(self, line_map: LineMap, config: SlamConfig) -> None:
        """Index a map. Raises InputError where it holds nothing to be found by."""
        if len(line_map) == 0 or line_map.cloud is None:
            raise InputError("the map has no landmarks or no cloud; map again with map.clouds true")
        self._matching = config.matching
        self._judging = config.relocalization.judging(config.matching)
        self._prepared: dict[int, _Place] = {}
        self.places = Places(line_map)
        self.retrieval = MapRetrieval(self.places, config.matching)

    def find(self, view: View) -> MapAnswer:
        """Find the pose of a view in the map."""
        query = PreparedView(view, self._matching)
        guesses = self.guesses(query)
        if not guesses:
            count = len(query.verticals)
            return _no(f"no constellation of the map fits the {count} standing lines")
        return self._decide(self._refine_best(query, guesses))

    def guesses(self, query: PreparedView) -> list[MapGuess]:
        """Return where a view may be, by its lines alone, best first."""
        return self.retrieval.guesses(query, NUM_GUESSES)

    def _refine_best(self, query: PreparedView, guesses: list[MapGuess]) -> list[_Found]:
        """Refine the guesses that the bird's-eye fields like best.

        Those that score far less than one which would do as the answer are no rivals to it.
        """
        lifted: list[tuple[float, int, Transform]] = []
        for guess in guesses:
            seen = self._place(guess.keyframe).prepared
            pose = flatten(query, seen, guess.T_place_lidar)
            agreement = float(field_agreement(query, seen, pose[None])[0])
            if agreement > MIN_FIELD:
                score = agreement + LINE_VOTE * guess.score
                reach_m = self._matching.inlier_distance_m
                pose = fit_planar(query.verticals, seen.verticals, pose, reach_m)
                lifted.append((score, guess.keyframe, lift(query, seen, pose)))
        lifted.sort(key=lambda one: -one[0])
        found: list[_Found] = []
        for score, keyframe, T_place_lidar in lifted[:NUM_REFINED]:
            if score < RIVAL_SHARE * lifted[0][0] and self._stands(found):
                break
            place = self._place(keyframe)
            evidence = gather_near(
                query, place.prepared, place.dense, T_place_lidar, self._matching
            )
            if evidence is not None:
                T_map_lidar = self.places.frame(keyframe) @ evidence.T_target_source
                found.append(_Found(T_map_lidar, keyframe, evidence))
        return sorted(found, key=lambda one: -one.evidence.log_odds)

    def _stands(self, found: list[_Found]) -> bool:
        """Tell whether a guess that was refined would do as the answer."""
        return any(not objection(one.evidence, self._judging) for one in found)

    def _decide(self, found: list[_Found]) -> MapAnswer:
        if not found:
            return _no("seen from above, nothing stands as in the map where lines would place it")
        best = found[0]
        reason = objection(best.evidence, self._judging)
        if reason:
            return _no(reason)
        others = [one for one in found if not same_pose(one.T_map_lidar, best.T_map_lidar)]
        lead = best.evidence.log_odds - max(
            (one.evidence.log_odds for one in others), default=-np.inf
        )
        if lead < MIN_LEAD:
            return _no("two places of the map fit the scan about equally well")
        answer = Relocalization(
            success=True,
            T_map_lidar=best.T_map_lidar,
            information=best.evidence.information,
            num_inliers=len(best.evidence.matches),
            confidence=confidence(best.evidence.log_odds, float(lead)),
        )
        return MapAnswer(answer, best.keyframe)

    def _place(self, keyframe: int) -> _Place:
        found = self._prepared.pop(keyframe, None)
        if found is None:
            found = _Place(PreparedView(self.places.view(keyframe), self._matching))
        self._prepared[keyframe] = found
        if len(self._prepared) > CACHE_SIZE:
            del self._prepared[next(iter(self._prepared))]
        return found


def confidence(log_odds: float, lead: float) -> float:
    """Return how far an answer may be trusted, in [0, 1]: its odds, and its lead over the next.

    A logistic curve, fitted as Platt does, to 164 right places of a simulated town's map (scans of
    another day, both ways) and 80 wrong ones (of 265 scans of other towns and of real streets): the
    right had log odds from 3.6 up, the wrong -6.4 at most.
    """
    right = 1.0 / (1.0 + np.exp(-CONFIDENCE_SLOPE * log_odds - CONFIDENCE_BIAS))
    alone = 1.0 / (1.0 + np.exp(-lead))
    return float(right * alone)


def same_pose(T_map_a: Transform, T_map_b: Transform) -> bool:
    """Tell whether two answers are one: less than 2 m and 8 degrees apart."""
    T_a_b = invert(T_map_a) @ T_map_b
    return bool(distance_m(T_a_b) < SAME_POSE_M and rotation_angle_rad(T_a_b) < SAME_POSE_RAD)


def _no(reason: str) -> MapAnswer:
    return MapAnswer(Relocalization(False, None, np.zeros((6, 6)), 0, 0.0, reason), -1)

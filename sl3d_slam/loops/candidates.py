"""Which earlier views a new one may revisit: by constellation from anywhere, and by estimate."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from sl3d_slam.config import LoopSettings
from sl3d_slam.geometry.se3 import Transform, invert
from sl3d_slam.loops.constellations import PlaceVote

SAME_PLACE_M = 15.0
DRIFT_SHARE = 0.02
# of the distance between two views: on real streets a loop is off by up to 1 % of it (KITTI raw
# 0005: 0.2 to 0.4 m rms 15 to 45 m apart, 0001: 0.02 to 0.09), and odometry should be worse by far
LEAST_DRIFT_SHARE = 0.02


@dataclass(frozen=True, slots=True)
class NearbyView:
    """An earlier view whose estimated position is close, with the estimate as first guess."""

    view_id: int
    T_view_query: Transform


def is_worth_a_loop(distance_m: float, drift_m: float, settings: LoopSettings) -> bool:
    """Tell whether a loop between views so far apart would say more than the odometry does.

    ``drift_m`` is how uncertain the odometry is about one seen from the other (standard deviation).
    Far views are worth it after a long way or where odometry is poor; along a street it knows
    better.
    """
    return distance_m <= min(settings.max_distance_m, drift_m / LEAST_DRIFT_SHARE)


def thin_votes(
    votes: list[PlaceVote], travelled_m: Mapping[int, float], settings: LoopSettings
) -> list[PlaceVote]:
    """Keep well-voted views, one a place (15 m of travel), best first."""
    kept: list[PlaceVote] = []
    for vote in votes:
        near = (
            abs(travelled_m[vote.view_id] - travelled_m[k.view_id]) < SAME_PLACE_M for k in kept
        )
        if vote.votes >= settings.min_votes and not any(near):
            kept.append(vote)
    return kept[: settings.max_candidates]


def nearest_by_estimate(
    query_id: int,
    newest_id: int,
    estimates: Mapping[int, Transform],
    travelled_m: Mapping[int, float],
    settings: LoopSettings,
) -> NearbyView | None:
    """Return the earlier view nearest to the query's estimate, within what drift may explain."""
    ids = [k for k in estimates if k <= newest_id]
    if not ids:
        return None
    centre = estimates[query_id][:3, 3]
    positions = np.array([estimates[k][:3, 3] for k in ids])
    gaps_m = np.linalg.norm((positions - centre)[:, :2], axis=1)
    nearest = int(np.argmin(gaps_m))
    drift_m = DRIFT_SHARE * (travelled_m[query_id] - travelled_m[ids[nearest]])
    if gaps_m[nearest] > settings.nearby_m + min(drift_m, settings.nearby_m):
        return None
    T_view_query = invert(estimates[ids[nearest]]) @ estimates[query_id]
    return NearbyView(ids[nearest], T_view_query)

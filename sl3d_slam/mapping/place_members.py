"""Compiled: the landmarks around each place that count most."""

from typing import no_type_check

import numpy as np
from jaxtyping import Float64, Int32, Int64
from numba import njit


def strongest_members(
    near: tuple[Int64[np.ndarray, "O"], Int64[np.ndarray, "N"]],
    seen: tuple[Int64[np.ndarray, "K"], Int64[np.ndarray, "S"]],
    ranks: Int64[np.ndarray, "L"],
    reach: tuple[Float64[np.ndarray, "P 2"], Float64[np.ndarray, "L 2"], float],
    limit: int,
) -> Int32[np.ndarray, "P M"]:
    """Return the best-ranked landmarks of each place, -1 after the last.

    Parameters
    ----------
    near : offsets of each place into the keyframes around it, and those keyframes.
    seen : offsets of each keyframe into the landmarks it saw, and those landmarks.
    ranks : each landmark's rank, 0 the best, no two alike; -1 where it does not count.
    reach : places and landmarks seen from above, and how far apart they may be, metres.
    limit : of landmarks a place.
    """
    by_rank = np.full(int(ranks.max(initial=-1)) + 1, -1, np.int32)
    counted = np.flatnonzero(ranks >= 0)
    by_rank[ranks[counted]] = counted
    return _strongest_members(near, seen, ranks, by_rank, reach, limit)


@njit(cache=True)
@no_type_check
def _strongest_members(
    around: tuple[np.ndarray, np.ndarray],
    sightings: tuple[np.ndarray, np.ndarray],
    ranks: np.ndarray,
    by_rank: np.ndarray,
    reach: tuple[np.ndarray, np.ndarray, float],
    limit: int,
) -> np.ndarray:
    near_starts, near = around
    seen_starts, seen = sightings
    places_xy, landmarks_xy, reach_m = reach
    members = np.full((len(places_xy), limit), -1, np.int32)
    met = np.full(len(ranks), -1, np.int64)
    found = np.empty(len(by_rank), np.int64)
    for p in range(len(places_xy)):
        n = 0
        for k in near[near_starts[p] : near_starts[p + 1]]:
            for landmark in seen[seen_starts[k] : seen_starts[k + 1]]:
                if ranks[landmark] < 0 or met[landmark] == p:
                    continue
                met[landmark] = p
                x = landmarks_xy[landmark, 0] - places_xy[p, 0]
                y = landmarks_xy[landmark, 1] - places_xy[p, 1]
                if x * x + y * y < reach_m * reach_m:
                    found[n] = ranks[landmark]
                    n += 1
        found[:n].sort()
        for m in range(min(n, limit)):
            members[p, m] = by_rank[found[m]]
    return members

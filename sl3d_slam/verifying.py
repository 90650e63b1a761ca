"""Which candidates of a keyframe are loops: a function of their views and of nothing else.

So it does not matter in which process it is worked out, nor when.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sl3d_slam.config import SlamConfig
from sl3d_slam.geometry.se3 import Transform
from sl3d_slam.matching.judge import gather_evidence, objection
from sl3d_slam.matching.prepared import PreparedView, lift
from sl3d_slam.matching.seeds import field_agreement
from sl3d_slam.matching.views import from_bytes, unpack
from sl3d_slam.types import LoopConstraint, Rejection

PlanarPose = tuple[float, float, float]  # yaw, x, y of the query in the target, both levelled


@dataclass(frozen=True, slots=True)
class Candidates:
    """Earlier keyframes that a keyframe may revisit, and the views to tell by.

    Attributes
    ----------
    by_lines : those that constellations vote for, best first.
    by_estimate : the one that is nearest by the estimates, with ``T_target_query``; it counts where
        what stands around agrees with none of ``by_lines``.
    packed : views as bytes, of the query and of every target.
    """

    query_id: int
    by_lines: Sequence[tuple[int, PlanarPose]]
    by_estimate: tuple[int, Transform] | None
    packed: Mapping[int, bytes]

    def __len__(self) -> int:
        """Return the number of candidates."""
        return len(self.by_lines) + (self.by_estimate is not None)


def verify(candidates: Candidates, config: SlamConfig) -> list[LoopConstraint | Rejection]:
    """Align the candidates whose surroundings agree; one answer for each of them."""
    views = {
        keyframe_id: PreparedView(unpack(from_bytes(raw)), config.matching)
        for keyframe_id, raw in candidates.packed.items()
    }
    query, guesses = views[candidates.query_id], {}
    for target_id, planar in candidates.by_lines:
        target, pose = views[target_id], np.array(planar)
        if field_agreement(query, target, pose[None])[0] > config.loops.min_field_agreement:
            guesses[target_id] = lift(query, target, pose)
    if not guesses and candidates.by_estimate is not None:
        guesses = dict([candidates.by_estimate])
    return [
        _answer((target_id, candidates.query_id), views, T_target_query, config)
        for target_id, T_target_query in guesses.items()
    ]


def _answer(
    pair: tuple[int, int],
    views: Mapping[int, PreparedView],
    T_guess: Transform,
    config: SlamConfig,
) -> LoopConstraint | Rejection:
    """Refine a guess and judge it; the pair is target, then query."""
    target, query = (views[keyframe_id] for keyframe_id in pair)
    evidence = gather_evidence(query, target, T_guess, config.matching)
    if evidence is None:
        return Rejection(*pair, "a scan has too few points to verify a loop with", T_guess)
    needed = config.loops.judging(config.matching)
    reason, num_inliers = objection(evidence, needed), len(evidence.matches)
    if reason:
        return Rejection(*pair, reason, evidence.T_target_source, num_inliers)
    return LoopConstraint(*pair, evidence.T_target_source, evidence.information, num_inliers)

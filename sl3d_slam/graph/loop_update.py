"""What a keyframe brings to a graph that somebody else owns."""

from collections.abc import Iterable
from dataclasses import dataclass, field

import gtsam

from sl3d_slam.errors import GraphError
from sl3d_slam.graph.ledger import FactorLedger
from sl3d_slam.graph.solve import Edge
from sl3d_slam.graph.verdicts import Verdict
from sl3d_slam.types import LoopConstraint, Rejection


@dataclass(frozen=True, slots=True, eq=False)
class LoopUpdate:
    """What to pass on to the solver; ids in the records are the user's keys.

    Attributes
    ----------
    factors : gtsam.NonlinearFactorGraph to add; the user may add more to it.
    initial : gtsam.Values to add: ``T_world_lidar`` of the new keyframe.
    loops : what the loop factors measure: ``T_target_query`` from target key to query key.
    rejected : candidates that are not used, with the reason.
    taken_back : loops that were handed out before and are believed no more, with the reason.
    revoked : indices, in the user's graph, of factors to remove.
    """

    factors: gtsam.NonlinearFactorGraph = field(default_factory=gtsam.NonlinearFactorGraph)
    initial: gtsam.Values = field(default_factory=gtsam.Values)
    loops: list[LoopConstraint] = field(default_factory=list)
    rejected: list[Rejection] = field(default_factory=list)
    taken_back: list[Rejection] = field(default_factory=list)
    indices: list[int] | None = field(default_factory=list)

    @property
    def revoked(self) -> list[int]:
        """Return the indices, in the user's graph, of factors to remove.

        Raises GraphError where there are some and the graph is not known.
        """
        if self.indices is None:
            raise GraphError(
                "a loop is taken back but where its factor is in your graph is not known; expected "
                "LineLoopFrontend(config, graph=isam.getFactorsUnsafe)"
            )
        return self.indices


def conclude(
    ledger: FactorLedger, verdicts: Iterable[Verdict], rejections: Iterable[Rejection]
) -> LoopUpdate:
    """Turn verdicts into factors to add and to remove; the last verdict on a loop counts."""
    factors = gtsam.NonlinearFactorGraph()
    loops: list[LoopConstraint] = []
    rejected = list(rejections)
    taken_back: list[Rejection] = []
    for verdict in {verdict.index: verdict for verdict in verdicts}.values():
        loop, handed = verdict.loop, verdict.index in ledger
        if verdict.status != "accepted":
            no = Rejection(
                loop.target_id,
                loop.query_id,
                verdict.reason,
                loop.T_target_query,
                loop.num_inliers,
            )
            (taken_back if handed else rejected).append(no)
            if handed:
                ledger.take_back(verdict.index)
        elif not handed:
            loops.append(loop)
            edge = Edge(loop.target_id, loop.query_id, loop.T_target_query, loop.information)
            factor = ledger.hand_over(verdict.index, edge)
            if factor is not None:
                factors.add(factor)
    return LoopUpdate(
        factors,
        loops=loops,
        rejected=rejected,
        taken_back=taken_back,
        indices=ledger.indices_to_remove(),
    )

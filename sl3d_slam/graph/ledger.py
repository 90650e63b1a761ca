"""Loop factors in a graph that somebody else owns: which were handed out, and where they are now.

A user's solver numbers factors as it likes, among factors we never see. So no index is remembered
or guessed: a factor to remove is looked up in the user's graph at the moment it is needed, by its
two keys and its measured pose.
"""

from collections.abc import Callable, Hashable

import gtsam

from sl3d_slam.graph.solve import Edge, between_factor

SAME_POSE = 1e-9  # rad and m; a measured pose does not change, a noise model may be made robust


class FactorLedger:
    """Factors by a name of the caller's choice.

    Parameters
    ----------
    graph : returns the user's present graph, such as ``isam.getFactorsUnsafe``; it is only read.
        None where it is not known.
    """

    def __init__(self, graph: Callable[[], gtsam.NonlinearFactorGraph] | None) -> None:
        self._graph = graph
        self._handed: dict[Hashable, Edge] = {}
        self._leaving: dict[Hashable, Edge] = {}

    def __contains__(self, name: Hashable) -> bool:
        """Tell whether the user has this factor, and is meant to keep it."""
        return name in self._handed

    def hand_over(self, name: Hashable, edge: Edge) -> gtsam.BetweenFactorPose3 | None:
        """Return the factor to add; None where the user still has it, as it never left."""
        still_there = self._leaving.pop(name, None)
        self._handed[name] = edge
        return between_factor(edge) if still_there is None else None

    def take_back(self, name: Hashable) -> None:
        """Ask for a factor to be removed."""
        self._leaving[name] = self._handed.pop(name)

    def indices_to_remove(self) -> list[int] | None:
        """Return where the factors to remove are, each once; None where that cannot be known.

        A factor that is not in the graph yet (its update still waits) is named by a later call.
        """
        if not self._leaving:
            return []
        if self._graph is None:
            return None
        graph = self._graph()
        found = []
        for index in range(graph.size()):
            name = self._leaving_at(graph, index)
            if name is not None:
                found.append(index)
                del self._leaving[name]
        return found

    def _leaving_at(self, graph: gtsam.NonlinearFactorGraph, index: int) -> Hashable | None:
        factor = graph.at(index)
        if not isinstance(factor, gtsam.BetweenFactorPose3):  # another kind, or removed: None
            return None
        first, second = factor.keys()
        for name, edge in self._leaving.items():
            if (edge.first, edge.second) == (first, second):
                measured = gtsam.Pose3(edge.T_first_second)
                if factor.measured().equals(measured, SAME_POSE):
                    return name
        return None

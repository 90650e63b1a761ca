"""Small factor graphs of poses: build, check that they hang together, optimise."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from sl3d_slam.errors import GraphError
from sl3d_slam.geometry.se3 import Transform
from sl3d_slam.graph.noise import Matrix6, information_to_gtsam

ANCHOR_SIGMA = 1e-4  # rad and m; fixes the world frame, and no more


@dataclass(frozen=True, slots=True, eq=False)
class Edge:
    """A relative pose ``T_first_second``; information rotation first, at the second's frame."""

    first: int
    second: int
    T_first_second: Transform
    information: Matrix6


@dataclass(frozen=True, slots=True, eq=False)
class Prior:
    """An absolute pose ``T_world_key``; information rotation first, at the key's frame."""

    key: int
    T_world_key: Transform
    information: Matrix6


def between_factor(edge: Edge) -> gtsam.BetweenFactorPose3:
    """Return gtsam's factor; raises GraphError where the information is rank deficient."""
    return gtsam.BetweenFactorPose3(
        edge.first,
        edge.second,
        gtsam.Pose3(edge.T_first_second),
        information_to_gtsam(edge.information),
    )


def prior_factor(prior: Prior) -> gtsam.PriorFactorPose3:
    """Return gtsam's factor; raises GraphError where the information is rank deficient."""
    return gtsam.PriorFactorPose3(
        prior.key, gtsam.Pose3(prior.T_world_key), information_to_gtsam(prior.information)
    )


def anchor(key: int, T_world_key: Transform) -> Prior:
    """Return the prior that holds one key still, so that the others have a frame."""
    return Prior(key, T_world_key, np.eye(6) / ANCHOR_SIGMA**2)


def require_connected(keys: Sequence[int], edges: Iterable[Edge], priors: Sequence[Prior]) -> None:
    """Check that every key hangs, over edges, on a key with a prior.

    Raises
    ------
    GraphError
        naming keys without a pose, or keys that nothing ties to the rest: gtsam would report an
        indeterminate system and one key at random.
    """
    position = {key: index for index, key in enumerate(keys)}
    pairs = [(edge.first, edge.second) for edge in edges]
    used = [key for pair in pairs for key in pair] + [prior.key for prior in priors]
    unknown = sorted({key for key in used if key not in position})
    if unknown:
        raise GraphError(f"the graph has factors on {_named(unknown)} without an initial pose")
    ends = np.array([[position[a], position[b]] for a, b in pairs], dtype=np.int64).reshape(-1, 2)
    ones = np.ones(len(ends), dtype=np.int8)
    links = coo_matrix((ones, (ends[:, 0], ends[:, 1])), shape=(len(keys), len(keys)))
    _, labels = connected_components(links, directed=False)
    held = {int(labels[position[prior.key]]) for prior in priors}
    loose = sorted(key for key in keys if int(labels[position[key]]) not in held)
    if loose:
        raise GraphError(
            f"the graph is in pieces: no factor ties {_named(loose)} to a key whose pose is fixed; "
            "add a loop or a prior that does"
        )


def optimise(
    poses: Mapping[int, Transform], edges: Sequence[Edge], priors: Sequence[Prior]
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """Solve for all poses by Levenberg-Marquardt with Gaussian noise; return graph and solution.

    ``poses`` are the initial ``T_world_key``. Raises GraphError for a graph in pieces, a rank
    deficient factor or a solution that is not finite.
    """
    require_connected(list(poses), edges, priors)
    graph = gtsam.NonlinearFactorGraph()
    for prior in priors:
        graph.add(prior_factor(prior))
    for edge in edges:
        graph.add(between_factor(edge))
    initial = gtsam.Values()
    for key, pose in poses.items():
        initial.insert(key, gtsam.Pose3(pose))
    return graph, levenberg_marquardt(graph, initial)


def levenberg_marquardt(graph: gtsam.NonlinearFactorGraph, initial: gtsam.Values) -> gtsam.Values:
    """Run gtsam's optimiser with tolerances that reach the optimum to well below a millimetre."""
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(100)
    parameters.setRelativeErrorTol(1e-12)
    parameters.setAbsoluteErrorTol(1e-10)
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, initial, parameters)
    try:
        solution = optimizer.optimize()
    except RuntimeError as error:
        raise GraphError(f"the graph cannot be solved: {str(error).splitlines()[0]}") from None
    if not np.isfinite(optimizer.error()):
        raise GraphError("the graph cannot be solved: its error is not finite")
    return solution


def _named(keys: Sequence[int]) -> str:
    """Name up to five keys, symbols by letter and index."""
    names = [str(key) if key < 1 << 56 else gtsam.Symbol(key).string() for key in keys[:5]]
    more = f" and {len(keys) - 5} more" if len(keys) > 5 else ""
    return f"key{'s' if len(keys) > 1 else ''} {', '.join(names)}{more}"

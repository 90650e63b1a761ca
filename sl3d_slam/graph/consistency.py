"""Do loops agree with the odometry and with one another? Chi-square tests with covariances.

A loop that agrees with the odometry chain closes the cycle
``Z^-1 T_target_query(odometry) = identity``; two loops that agree with each other close
``Z_a T_qa_qb Z_b^-1 T_tb_ta = identity`` (pairwise consistency, Mangelson et al. 2018). Each test
weighs the cycle's error with the covariance of everything on the way.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from sl3d_slam.graph.batched import (
    Matrices6,
    Transforms,
    adjoints,
    conjugates,
    inverts,
    logs,
    squared_norms,
)
from sl3d_slam.graph.chain import OdometryChain
from sl3d_slam.types import LoopConstraint


@dataclass(frozen=True, slots=True, eq=False)
class LoopArrays:
    """Loops as columns: chain positions of their ends, transforms and covariances (at query)."""

    targets: Int64[np.ndarray, "N"]
    queries: Int64[np.ndarray, "N"]
    T_target_query: Transforms
    covariances: Matrices6

    def take(self, indices: np.ndarray | slice) -> "LoopArrays":
        """Return the chosen loops."""
        return LoopArrays(
            self.targets[indices],
            self.queries[indices],
            self.T_target_query[indices],
            self.covariances[indices],
        )


def stack_loops(chain: OdometryChain, loops: list[LoopConstraint]) -> LoopArrays:
    """Put full-rank loops into columns."""
    return LoopArrays(
        np.array([chain.position(loop.target_id) for loop in loops], dtype=np.int64),
        np.array([chain.position(loop.query_id) for loop in loops], dtype=np.int64),
        np.array([loop.T_target_query for loop in loops]).reshape(-1, 4, 4),
        np.array([np.linalg.inv(loop.information) for loop in loops]).reshape(-1, 6, 6),
    )


@dataclass(frozen=True, slots=True)
class OdometryCheck:
    """How a loop stands against odometry alone.

    Attributes
    ----------
    squared : squared Mahalanobis distance (6 degrees of freedom) with the nominal drift.
    squared_inflated : the same with the drift's sigmas inflated.
    offset_m, offset_deg : how far the loop's pose lies from the odometry's.
    sigma_m : standard deviation of the odometry's position along its weakest direction.
    """

    squared: float
    squared_inflated: float
    offset_m: float
    offset_deg: float
    sigma_m: float


def check_odometry(chain: OdometryChain, loop: LoopArrays, inflation: float) -> OdometryCheck:
    """Compare one loop (a column set of length 1) with the odometry between its ends."""
    T_target_query = inverts(chain.poses(loop.targets)) @ chain.poses(loop.queries)
    residuals = logs(inverts(loop.T_target_query) @ T_target_query)
    drift = chain.covariances(loop.targets, loop.queries)
    both = np.concatenate([drift, inflation**2 * drift]) + loop.covariances
    squared, inflated = squared_norms(np.repeat(residuals, 2, axis=0), both)
    return OdometryCheck(
        squared=float(squared),
        squared_inflated=float(inflated),
        offset_m=float(np.linalg.norm(residuals[0, 3:])),
        offset_deg=float(np.degrees(np.linalg.norm(residuals[0, :3]))),
        sigma_m=float(np.sqrt(np.linalg.eigvalsh(drift[0, 3:, 3:])[-1])),
    )


def check_pairs(
    chain: OdometryChain, loop: LoopArrays, others: LoopArrays
) -> tuple[Float64[np.ndarray, "N"], Float64[np.ndarray, "N"]]:
    """Compare one loop (length 1) with many others.

    Returns
    -------
    squared : squared Mahalanobis distance of each cycle, 6 degrees of freedom.
    spread : how sharply the other predicts this loop's translation: trace of covariance, m^2.
    """
    one = loop.take(np.zeros(len(others.targets), dtype=np.int64))
    T_ta_odom = one.T_target_query @ inverts(chain.poses(one.queries))
    T_ta_qb = T_ta_odom @ chain.poses(others.queries)
    T_ta_tb = T_ta_qb @ inverts(others.T_target_query)
    T_back_odom = T_ta_tb @ inverts(chain.poses(others.targets))
    residuals = logs(T_back_odom @ chain.poses(one.targets))
    predicted = _odometry_noise(chain, one, others, (adjoints(T_ta_odom), adjoints(T_back_odom)))
    predicted = predicted + conjugates(adjoints(T_ta_qb), others.covariances)
    own = conjugates(adjoints(one.T_target_query), one.covariances)
    return squared_norms(residuals, predicted + own), _translation_trace(predicted)


def drift_spread(chain: OdometryChain, loops: LoopArrays) -> Float64[np.ndarray, "N"]:
    """Return how sharply odometry alone predicts each loop's translation: trace, m^2."""
    return _translation_trace(chain.covariances(loops.targets, loops.queries))


def _translation_trace(covariances: Matrices6) -> Float64[np.ndarray, "N"]:
    return np.trace(covariances[:, 3:, 3:], axis1=1, axis2=2)


def _odometry_noise(
    chain: OdometryChain, one: LoopArrays, others: LoopArrays, maps: tuple[Matrices6, Matrices6]
) -> Matrices6:
    """Return the noise of the two odometry legs ``qa -> qb`` and ``tb -> ta`` of a cycle.

    Steps that both legs pass are the same noise twice, so their cross terms count.
    """
    there, back = maps
    noise = conjugates(there, chain.noise_between(one.queries, others.queries))
    noise = noise + conjugates(back, chain.noise_between(others.targets, one.targets))
    low = np.maximum(
        np.minimum(one.queries, others.queries), np.minimum(one.targets, others.targets)
    )
    high = np.minimum(
        np.maximum(one.queries, others.queries), np.maximum(one.targets, others.targets)
    )
    shared = chain.noise_between(low, np.maximum(low, high))
    sign = np.sign(others.queries - one.queries) * np.sign(one.targets - others.targets)
    cross = sign[:, None, None] * (there @ shared @ np.swapaxes(back, 1, 2))
    return noise + cross + np.swapaxes(cross, 1, 2)

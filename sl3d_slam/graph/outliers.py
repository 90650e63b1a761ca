"""GNC-TLS over the graph reduced to the loop ends: which loops fit together with the odometry?

Truncated least squares by graduated non-convexity (Yang et al. 2020), with the odometry as known
inliers. Only the keyframes where loops begin or end are variables; the odometry between successive
ones is composed with its covariance. gtsam's ``GncLMOptimizer`` starts every inner optimisation
from the first guess again; here each starts from the last, which is several times faster.
"""

from dataclasses import dataclass

import gtsam
import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.stats import chi2

from sl3d_slam.geometry.se3 import invert
from sl3d_slam.graph.chain import OdometryChain
from sl3d_slam.graph.consistency import LoopArrays
from sl3d_slam.graph.noise import covariance_to_gtsam
from sl3d_slam.graph.solve import ANCHOR_SIGMA

MU_FACTOR = 1.4
MAX_ITERATIONS = 60
MIN_WEIGHT = 1e-4  # below it a loop is left out of the inner problem


@dataclass(frozen=True, slots=True, eq=False)
class GncResult:
    """``weights`` in [0, 1] and squared residuals (6 degrees of freedom) of each loop."""

    weights: Float64[np.ndarray, "N"]
    squared: Float64[np.ndarray, "N"]
    threshold: float

    @property
    def inliers(self) -> Bool[np.ndarray, "N"]:
        """Return which loops fit."""
        return self.weights > 0.5


def gnc_tls(
    chain: OdometryChain,
    loops: LoopArrays,
    believed: Bool[np.ndarray, "N"],
    outlier_probability: float,
) -> GncResult:
    """Weigh loops by graduated non-convexity, starting from those believed to be true.

    The surrogate starts just convex enough for the believed loops (gtsam: for all), so loops
    that are far off from the start do not bend the solution.
    ``outlier_probability`` is the chance that an honest loop exceeds the truncation (chi-square, 6
    degrees of freedom).
    """
    threshold = float(chi2.ppf(1.0 - outlier_probability, 6))
    problem = _EndPointGraph(chain, loops)
    weights = believed.astype(np.float64)
    squared = problem.solve(weights)
    excess = 2.0 * float(squared[believed].max(initial=0.0)) - threshold
    if excess <= threshold:
        return GncResult((squared <= threshold).astype(np.float64), squared, threshold)
    mu = threshold / excess
    for _ in range(MAX_ITERATIONS):
        weights = _tls_weights(squared, threshold, mu)
        squared = problem.solve(weights)
        if np.all((weights == 0.0) | (weights == 1.0)):
            settled = _tls_weights(squared, threshold, np.inf)
            if np.array_equal(settled, weights):
                break
        mu *= MU_FACTOR
    return GncResult((squared <= threshold).astype(np.float64), squared, threshold)


def _tls_weights(
    squared: Float64[np.ndarray, "N"], threshold: float, mu: float
) -> Float64[np.ndarray, "N"]:
    """Return the weights of the truncated-least-squares surrogate at ``mu``.

    They fall from 1 at ``threshold * mu / (mu + 1)`` to 0 at ``threshold * (mu + 1) / mu``.
    """
    if np.isinf(mu):
        return (squared <= threshold).astype(np.float64)
    middle = np.sqrt(threshold * mu * (mu + 1.0) / np.maximum(squared, 1e-12)) - mu
    return np.clip(middle, 0.0, 1.0)


class _EndPointGraph:
    """The chain reduced to the loop ends; keeps its last solution as the next start."""

    def __init__(self, chain: OdometryChain, loops: LoopArrays) -> None:
        ends = np.unique(np.concatenate([loops.targets, loops.queries]))
        self._odometry = _odometry_factors(chain, ends)
        self._loops = loops
        self._information = np.linalg.inv(loops.covariances)
        self._values = gtsam.Values()
        for position in ends:
            self._values.insert(int(position), gtsam.Pose3(chain.pose(int(position))))
        self._parameters = gtsam.LevenbergMarquardtParams()
        self._parameters.setMaxIterations(30)
        self._parameters.setRelativeErrorTol(1e-4)

    def solve(self, weights: Float64[np.ndarray, "N"]) -> Float64[np.ndarray, "N"]:
        """Optimise with weighted loops; return every loop's unweighted squared residual."""
        graph = gtsam.NonlinearFactorGraph(self._odometry)
        for index in np.flatnonzero(weights > MIN_WEIGHT):
            graph.add(self._factor(int(index), float(weights[index])))
        optimizer = gtsam.LevenbergMarquardtOptimizer(graph, self._values, self._parameters)
        self._values = optimizer.optimize()
        errors = [self._factor(index, 1.0).error(self._values) for index in range(len(weights))]
        return 2.0 * np.array(errors)

    def _factor(self, index: int, weight: float) -> gtsam.BetweenFactorPose3:
        return gtsam.BetweenFactorPose3(
            int(self._loops.targets[index]),
            int(self._loops.queries[index]),
            gtsam.Pose3(self._loops.T_target_query[index]),
            gtsam.noiseModel.Gaussian.Information(weight * self._information[index], False),
        )


def _odometry_factors(
    chain: OdometryChain, ends: Int64[np.ndarray, "E"]
) -> gtsam.NonlinearFactorGraph:
    """Tie successive loop ends by the composed odometry and hold the first."""
    graph = gtsam.NonlinearFactorGraph()
    held = gtsam.noiseModel.Isotropic.Sigma(6, ANCHOR_SIGMA)
    first = int(ends[0])
    graph.add(gtsam.PriorFactorPose3(first, gtsam.Pose3(chain.pose(first)), held))
    covariances = chain.covariances(ends[:-1], ends[1:])
    for a, b, covariance in zip(ends[:-1].tolist(), ends[1:].tolist(), covariances, strict=True):
        T_a_b = invert(chain.pose(a)) @ chain.pose(b)
        noise = covariance_to_gtsam(covariance)
        graph.add(gtsam.BetweenFactorPose3(a, b, gtsam.Pose3(T_a_b), noise))
    return graph

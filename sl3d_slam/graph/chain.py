"""The odometry as one chain of keyframes with the covariance between any two of them."""

import numpy as np
from jaxtyping import Float64, Int64

from sl3d_slam.config import GraphSettings
from sl3d_slam.errors import GraphError
from sl3d_slam.geometry.se3 import Transform, adjoint, invert
from sl3d_slam.graph.batched import Matrices6, Transforms, adjoints, conjugates, inverts
from sl3d_slam.graph.noise import Matrix6, chain_covariance
from sl3d_slam.graph.rigid import rigid_transform


class OdometryChain:
    """Keyframe poses in the odometry frame; positions in the chain count from 0.

    The noise ``xi_k`` of step k acts on the right, ``T_odom_k exp(xi_k)``. Moved to the odometry
    frame it is ``Ad(T_odom_k) xi_k``, and there the noises of a chain simply add:
    ``T_a_b = T_odom_a^-1 exp(sum eta_k) T_odom_b`` for a < k <= b. So one running sum gives the
    covariance between any two keyframes.

    Real odometry errs the same way for a while (a wandering turn rate, a scale), so over a long
    stretch it drifts further than white steps would: the sum holds each step's noise times
    ``drift_inflation`` squared, while :meth:`append` returns that of the step itself.
    """

    def __init__(self, settings: GraphSettings) -> None:
        self._settings = settings
        self._inflation = settings.drift_inflation**2
        self._poses = np.zeros((64, 4, 4))
        self._sums = np.zeros((64, 6, 6))
        self._positions: dict[int, int] = {}

    def __len__(self) -> int:
        """Return the number of keyframes."""
        return len(self._positions)

    def __contains__(self, keyframe_id: int) -> bool:
        """Tell whether a keyframe is in the chain."""
        return keyframe_id in self._positions

    def append(self, keyframe_id: int, T_odom_lidar: Transform, num_scans: int) -> Matrix6 | None:
        """Add a keyframe ``num_scans`` steps after the last; return the covariance of the step.

        The covariance is at the new keyframe's frame; None for the first keyframe.
        """
        if keyframe_id in self._positions:
            raise GraphError(f"keyframe {keyframe_id} is already in the graph; ids must be new")
        T_odom_new = rigid_transform(T_odom_lidar, f"keyframe {keyframe_id}'s odometry")
        count = len(self)
        if count == len(self._poses):
            self._poses = np.concatenate([self._poses, np.zeros_like(self._poses)])
            self._sums = np.concatenate([self._sums, np.zeros_like(self._sums)])
        covariance = None
        if count:
            T_last_new = invert(self._poses[count - 1]) @ T_odom_new
            covariance = chain_covariance(T_last_new, num_scans, self._settings)
            Ad = adjoint(T_odom_new)
            noise = self._inflation * (Ad @ covariance @ Ad.T)
            self._sums[count] = self._sums[count - 1] + noise
        self._poses[count] = T_odom_new
        self._positions[keyframe_id] = count
        return covariance

    def position(self, keyframe_id: int) -> int:
        """Return where a keyframe is in the chain."""
        if keyframe_id not in self._positions:
            raise GraphError(f"keyframe {keyframe_id} is not in the graph; add it before its loops")
        return self._positions[keyframe_id]

    def poses(self, positions: Int64[np.ndarray, "N"]) -> Transforms:
        """Return ``T_odom_lidar`` of each."""
        return self._poses[positions]

    def pose(self, position: int) -> Transform:
        """Return ``T_odom_lidar`` of one."""
        return self._poses[position]

    def drift_m(self, first_id: int, last_id: int) -> float:
        """Return how uncertain the last keyframe's position is, seen from the first.

        It is the standard deviation of its distance from where the odometry puts it.
        """
        first, last = np.array([self.position(first_id)]), np.array([self.position(last_id)])
        (covariance,) = self.covariances(first, last)
        return float(np.sqrt(np.trace(covariance[3:, 3:])))

    def noise_between(
        self, first: Int64[np.ndarray, "N"], last: Int64[np.ndarray, "N"]
    ) -> Float64[np.ndarray, "N 6 6"]:
        """Return the covariance gathered between two positions, in the odometry frame."""
        low, high = np.minimum(first, last), np.maximum(first, last)
        return self._sums[high] - self._sums[low]

    def covariances(self, first: Int64[np.ndarray, "N"], last: Int64[np.ndarray, "N"]) -> Matrices6:
        """Return the covariance of ``T_first_last`` of each pair, at the last's frame."""
        return conjugates(adjoints(inverts(self._poses[last])), self.noise_between(first, last))

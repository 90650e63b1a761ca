"""Which relocalizations in a map to believe: the largest set that agrees along the odometry."""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float64
from scipy.stats import chi2

from sl3d_slam.config import GraphSettings
from sl3d_slam.graph.batched import adjoints, conjugates, inverts, logs, squared_norms
from sl3d_slam.graph.chain import OdometryChain
from sl3d_slam.graph.clique import maximum_clique
from sl3d_slam.graph.noise import Matrix6, weakness
from sl3d_slam.graph.verdicts import Status, Verdict
from sl3d_slam.types import LoopConstraint


class MapAnchor:
    """Judges constraints from a map's frame to keyframes of one odometry chain.

    A constraint's target is the map, its query the keyframe: ``T_target_query`` is ``T_map_lidar``.
    Two of them agree where the way between them through the map is that of the odometry (chi-square
    over six degrees of freedom, with the covariance of everything on the way). Believed is the
    largest set that agrees pair by pair, once it has ``min_agreeing_loops`` members.
    """

    def __init__(self, chain: OdometryChain, settings: GraphSettings) -> None:
        self._chain = chain
        self._threshold = float(chi2.ppf(settings.pairwise_probability, 6))
        self._min_members = settings.min_agreeing_loops
        self._verdicts: list[Verdict] = []
        self._covariances = np.zeros((0, 6, 6))
        self._agrees = np.zeros((0, 0), dtype=bool)

    def offer(self, constraint: LoopConstraint) -> list[Verdict]:
        """Judge a new constraint; return its verdict and every older one that it changes.

        Indices count down from -1, apart from those of loops. Raises GraphError where the keyframe
        is not in the chain.
        """
        index = -1 - len(self._verdicts)
        weak = weakness(constraint.information)
        covariance = np.full((6, 6), np.inf) if weak else np.linalg.inv(constraint.information)
        row = self._compare(constraint, covariance)
        own = np.array([[not weak]])
        self._agrees = np.block([[self._agrees, row[:, None]], [row[None, :], own]])
        self._covariances = np.concatenate([self._covariances, covariance[None]])
        self._verdicts.append(Verdict(index, constraint, "rejected", weak))
        changed = self._judge_all()
        mine = self._verdicts[-1]
        return [*changed, mine] if mine not in changed else changed

    def _compare(self, constraint: LoopConstraint, covariance: Matrix6) -> Bool[np.ndarray, "N"]:
        """Tell which earlier constraints agree with a new one; a weak one agrees with none."""
        position = self._chain.position(constraint.query_id)
        usable = np.flatnonzero(np.diag(self._agrees))
        agrees = np.zeros(len(self._agrees), dtype=bool)
        if len(usable) == 0 or not np.isfinite(covariance).all():
            return agrees
        loops = [self._verdicts[k].loop for k in usable]
        before = np.array([self._chain.position(loop.query_id) for loop in loops], dtype=np.int64)
        new = np.full_like(before, position)
        T_map_before = np.array([loop.T_target_query for loop in loops])
        T_before_new = inverts(T_map_before) @ constraint.T_target_query
        T_new_before = inverts(T_before_new)
        T_odometry = inverts(self._chain.poses(before)) @ self._chain.poses(new)
        spread: Float64[np.ndarray, "N 6 6"] = self._chain.covariances(before, new) + covariance
        spread = spread + conjugates(adjoints(T_new_before), self._covariances[usable])
        squared = squared_norms(logs(T_new_before @ T_odometry), spread)
        agrees[usable] = squared <= self._threshold
        return agrees

    def _judge_all(self) -> list[Verdict]:
        """Renew the verdicts; return those whose status changes."""
        usable = np.flatnonzero(np.diag(self._agrees))
        accepted = [k for k in usable if self._verdicts[k].status == "accepted"]
        incumbent = np.searchsorted(usable, accepted).tolist()
        clique = usable[maximum_clique(self._agrees[np.ix_(usable, usable)], incumbent)]
        believed = set(clique.tolist()) if len(clique) >= self._min_members else set()
        changed = []
        for member in usable:
            verdict = self._renewed(self._verdicts[member], int(member) in believed, len(clique))
            if verdict.status != self._verdicts[member].status:
                changed.append(verdict)
            self._verdicts[member] = verdict
        return changed

    def _renewed(self, last: Verdict, believed: bool, num_members: int) -> Verdict:
        status: Status = "rejected" if last.status == "rejected" else "revoked"
        if believed:
            status, reason = "accepted", f"one of {num_members} relocalizations that agree"
        elif num_members >= self._min_members:
            reason = f"contradicts {num_members} relocalizations that agree with one another"
        else:
            reason = f"waits for {self._min_members} relocalizations that agree"
        return replace(last, status=status, reason=reason)

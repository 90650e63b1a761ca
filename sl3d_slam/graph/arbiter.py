"""Which loops to believe: odometry check, pairwise consistency, GNC; verdicts may change."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool
from scipy.stats import chi2

from sl3d_slam.config import GraphSettings
from sl3d_slam.geometry.se3 import Transform
from sl3d_slam.graph import verdicts
from sl3d_slam.graph.agreement import Agreement
from sl3d_slam.graph.chain import OdometryChain
from sl3d_slam.graph.clique import maximum_clique
from sl3d_slam.graph.consistency import OdometryCheck, check_odometry, stack_loops
from sl3d_slam.graph.noise import Matrix6, weakness
from sl3d_slam.graph.outliers import gnc_tls
from sl3d_slam.graph.rigid import rigid_transform
from sl3d_slam.graph.verdicts import Status, Verdict
from sl3d_slam.types import LoopConstraint

Mask = Bool[np.ndarray, "N"]
RESETTLE_GROWTH = 1.5  # decide from scratch once the accepted loops have grown by this factor
MAX_DISSENT = 0.1  # contradicted by a smaller share of its confirming loops: left to GNC


class LoopArbiter:
    """Judges loops between keyframes of one odometry chain; knows no solver and no factor ids.

    A loop enters the contest when it has full rank and does not contradict generously inflated
    odometry. Accepted is the largest set of loops that agree with one another pair by pair, after
    GNC-TLS over the loop ends. A loop that fewer than ``min_agreeing_loops - 1`` others confirm
    stands alone: it must also agree with the odometry at its nominal covariance, and that
    covariance must be small enough for the agreement to mean something; so a false lone loop moves
    the map by no more than the drift could have. The rest waits, and wins when evidence comes.

    Attributes
    ----------
    verdicts : one for every loop ever offered, in that order.
    chain : the odometry.
    """

    def __init__(self, settings: GraphSettings) -> None:
        self._settings = settings
        self._gate = float(chi2.ppf(settings.odometry_check_probability, 6))
        self.chain = OdometryChain(settings)
        self.verdicts: list[Verdict] = []
        self._contest = Agreement(self.chain, float(chi2.ppf(settings.pairwise_probability, 6)))
        self._indices: list[int] = []  # of the contest's members among all loops
        self._checks: list[OdometryCheck] = []
        self._accepted: Mask = np.zeros(0, dtype=bool)
        self._misfits: dict[int, str] = {}  # members that GNC refused, until the next settling
        self._num_settled = 0

    def add_keyframe(
        self, keyframe_id: int, T_odom_lidar: Transform, num_scans: int
    ) -> Matrix6 | None:
        """Append to the chain; return the step's covariance at the new frame (None: first)."""
        return self.chain.append(keyframe_id, T_odom_lidar, num_scans)

    @property
    def accepted(self) -> list[Verdict]:
        """Return the loops believed now, in the order they were offered."""
        return [verdict for verdict in self.verdicts if verdict.status == "accepted"]

    def offer(self, loop: LoopConstraint) -> list[Verdict]:
        """Judge a new loop; return its verdict and every older verdict that it changes.

        Raises GraphError where an end of the loop is not a keyframe of the chain or its transform
        is not rigid.
        """
        index = len(self.verdicts)
        if not self._take(loop):
            return [self.verdicts[-1]]
        quick = self._quick_answer()
        if quick is None:
            changed = self.settle()
            mine = [verdict for verdict in changed if verdict.index == index]
            return changed if mine else [self.verdicts[index], *changed]
        newest = len(self._contest) - 1
        self._accepted[newest] = quick
        return [self._judge(newest)]

    def offer_all(self, loops: Sequence[LoopConstraint]) -> list[Verdict]:
        """Judge many loops together, as at the end of a drive; return a verdict for each.

        Raises GraphError as :meth:`offer` does.
        """
        first = len(self.verdicts)
        for loop in loops:
            self._take(loop)
        self.settle()
        return self.verdicts[first:]

    def settle(self) -> list[Verdict]:
        """Decide about all loops from scratch; return the verdicts whose status changes.

        Happens by itself when a new loop challenges the accepted ones or these have grown by half;
        call it once at the end of a run.
        """
        members = self._largest_set()
        chosen = np.flatnonzero(members | self._borderline(members))
        self._num_settled = len(chosen)
        accepted = np.zeros_like(members)
        self._misfits = {}
        if len(chosen):
            loops = self._contest.loops.take(chosen)
            probability = self._settings.gnc_outlier_probability
            gnc = gnc_tls(self.chain, loops, members[chosen], probability)
            accepted[chosen[gnc.inliers]] = True
            for k in np.flatnonzero(~gnc.inliers):
                reason = verdicts.does_not_fit(float(gnc.squared[k]), gnc.threshold)
                self._misfits[int(chosen[k])] = reason
        self._accepted = self._standing(accepted)
        return self._judge_all()

    def _unusable(self, loop: LoopConstraint) -> str:
        """Say why a loop cannot even enter the contest; remember its odometry check if it can."""
        if self.chain.position(loop.target_id) == self.chain.position(loop.query_id):
            return "joins a keyframe with itself"
        weak = weakness(loop.information)
        if weak:
            return weak
        arrays = stack_loops(self.chain, [loop])
        check = check_odometry(self.chain, arrays, self._settings.odometry_check_inflation)
        if check.squared_inflated > self._gate:
            return verdicts.contradicts_odometry(check, self._gate)
        self._checks.append(check)
        return ""

    def _take(self, loop: LoopConstraint) -> bool:
        """Let a loop into the contest, or write down why it cannot be; tell which."""
        name = f"the loop from keyframe {loop.query_id} to {loop.target_id}"
        loop = replace(loop, T_target_query=rigid_transform(loop.T_target_query, name))
        unusable = self._unusable(loop)
        if unusable:
            self.verdicts.append(Verdict(len(self.verdicts), loop, "rejected", unusable))
            return False
        self._enter(len(self.verdicts), loop)
        return True

    def _enter(self, index: int, loop: LoopConstraint) -> None:
        self.verdicts.append(Verdict(index, loop, "rejected", "not judged yet"))
        self._indices.append(index)
        self._contest.append(stack_loops(self.chain, [loop]))
        self._accepted = np.append(self._accepted, False)

    def _quick_answer(self) -> bool | None:
        """Accept or refuse the newest loop where that is clear without :meth:`settle`."""
        newest = len(self._contest) - 1
        row = self._contest.consistent[newest]
        num_against = int((self._accepted & ~row).sum())
        if num_against:
            # a set with the newest loop is at most this much larger than the accepted one
            advantage = int((row & ~self._accepted).sum()) - num_against
            return None if advantage > 0 else False
        waiting = self._contest.confirms[newest] & ~self._accepted
        waiting[list(self._misfits)] = False
        unopposed = self._contest.consistent[:, self._accepted].all(axis=1)
        num_accepted = int(self._accepted.sum())
        if (waiting & unopposed).any() or num_accepted >= max(
            8, RESETTLE_GROWTH * self._num_settled
        ):
            return None
        return self._stands(newest, self._accepted)

    def _largest_set(self) -> Mask:
        """Return the largest set of loops that agree pair by pair; ties stay with the accepted."""
        consistent = self._contest.consistent
        eligible = np.flatnonzero(self._standing(np.ones(len(self._contest), dtype=bool)))
        incumbent: list[int] = []
        for k, vertex in enumerate(eligible):
            if self._accepted[vertex] and consistent[vertex, eligible[incumbent]].all():
                incumbent.append(k)
        clique = maximum_clique(consistent[np.ix_(eligible, eligible)], incumbent)
        members = np.zeros(len(self._contest), dtype=bool)
        members[eligible[clique]] = True
        return self._standing(members)

    def _borderline(self, members: Mask) -> Mask:
        """Return loops outside the set that hardly any of the loops near them contradict."""
        against = (~self._contest.consistent & members).sum(axis=1)
        confirming = (self._contest.confirms & members).sum(axis=1)
        return ~members & (confirming > 0) & (against <= MAX_DISSENT * confirming)

    def _standing(self, members: Mask) -> Mask:
        """Drop loops that stand alone and may not, until the rest confirm one another."""
        while True:
            kept = members.copy()
            for k in np.flatnonzero(members):
                kept[k] = self._stands(int(k), members)
            if np.array_equal(kept, members):
                return kept
            members = kept

    def _stands(self, member: int, others: Mask) -> bool:
        """Tell whether enough others confirm a loop, or it may stand alone."""
        num_confirming = int((self._contest.confirms[member] & others).sum())
        if num_confirming >= self._settings.min_agreeing_loops - 1:
            return True
        check = self._checks[member]
        certain = check.sigma_m <= self._settings.lone_loop_max_sigma_m
        return certain and check.squared <= self._gate

    def _judge_all(self) -> list[Verdict]:
        """Renew every verdict of the contest; return those whose status changes."""
        changed = []
        for member, index in enumerate(self._indices):
            before = self.verdicts[index].status
            verdict = self._judge(member)
            if verdict.status != before:
                changed.append(verdict)
        return changed

    def _judge(self, member: int) -> Verdict:
        """Write down a member's verdict, as it follows from the accepted set."""
        last = self.verdicts[self._indices[member]]
        num_confirming = int((self._contest.confirms[member] & self._accepted).sum())
        num_against = int((~self._contest.consistent[member] & self._accepted).sum())
        status: Status = "rejected" if last.status == "rejected" else "revoked"
        if self._accepted[member]:
            status = "accepted"
            reason = verdicts.agrees(self._checks[member], num_confirming)
        elif member in self._misfits:
            reason = self._misfits[member]
        elif num_against:
            reason = verdicts.contradicts_loops(num_against, int(self._accepted.sum()))
        else:
            limit = self._settings.lone_loop_max_sigma_m
            reason = verdicts.stands_alone(self._checks[member], num_confirming, limit)
        verdict = Verdict(last.index, last.loop, status, reason)
        self.verdicts[last.index] = verdict
        return verdict

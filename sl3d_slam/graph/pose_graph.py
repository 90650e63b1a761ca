"""The live pose graph: keyframes and accepted loops in iSAM2, verdicts that may change."""

from collections.abc import Iterable, Sequence

import gtsam
import numpy as np

from sl3d_slam.config import GraphSettings
from sl3d_slam.errors import GraphError
from sl3d_slam.geometry.se3 import Transform, invert
from sl3d_slam.graph.arbiter import LoopArbiter
from sl3d_slam.graph.chain import OdometryChain
from sl3d_slam.graph.noise import covariance_to_gtsam
from sl3d_slam.graph.solve import Edge, anchor, between_factor, prior_factor
from sl3d_slam.graph.verdicts import Verdict
from sl3d_slam.types import LoopConstraint

NUM_EXTRA_UPDATES = 2  # after a loop; later keyframes go on relinearising what still moves
RELINEARIZE_SKIP = 10  # keyframes between two looks for what moved far: each look costs time
MAX_FINAL_UPDATES = 20  # when settling, until nothing is relinearised any more


class PoseGraph:
    """Keyframe poses while a run goes on; the world frame is the odometry's at the first keyframe.

    Keys are the keyframe ids. Loops go through :class:`LoopArbiter`; iSAM2 holds the odometry and
    the loops accepted now, and a revoked loop leaves by its factor index.
    """

    def __init__(self, settings: GraphSettings) -> None:
        self._arbiter = LoopArbiter(settings)
        parameters = gtsam.ISAM2Params()
        parameters.setRelinearizeThreshold(0.05)
        parameters.relinearizeSkip = RELINEARIZE_SKIP
        parameters.enablePartialRelinearizationCheck = True  # else it looks at every keyframe
        self._isam = gtsam.ISAM2(parameters)
        self._factor_ids: dict[int, int] = {}  # of the accepted loops, by verdict index
        self._keyframe_ids: list[int] = []

    @property
    def keyframe_ids(self) -> list[int]:
        """Return the ids in the order they were added."""
        return list(self._keyframe_ids)

    @property
    def chain(self) -> OdometryChain:
        """Return the odometry."""
        return self._arbiter.chain

    @property
    def verdicts(self) -> list[Verdict]:
        """Return what became of every loop ever offered, in that order."""
        return list(self._arbiter.verdicts)

    @property
    def accepted_loops(self) -> list[LoopConstraint]:
        """Return the loops that are in the graph now."""
        return [verdict.loop for verdict in self._arbiter.accepted]

    def add_keyframe(
        self, keyframe_id: int, T_odom_lidar: Transform, num_scans_since_last: int
    ) -> None:
        """Append a keyframe to the chain; ``num_scans_since_last`` is ignored for the first.

        Raises GraphError where the id is taken or the pose is not rigid.
        """
        covariance = self._arbiter.add_keyframe(keyframe_id, T_odom_lidar, num_scans_since_last)
        chain = self._arbiter.chain
        T_odom_new = chain.pose(chain.position(keyframe_id))
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        if covariance is None:
            graph.add(prior_factor(anchor(keyframe_id, T_odom_new)))
            values.insert(keyframe_id, gtsam.Pose3(T_odom_new))
        else:
            last_id = self._keyframe_ids[-1]
            T_last_new = invert(chain.pose(chain.position(last_id))) @ T_odom_new
            noise = covariance_to_gtsam(covariance)
            measured = gtsam.Pose3(T_last_new)
            graph.add(gtsam.BetweenFactorPose3(last_id, keyframe_id, measured, noise))
            values.insert(keyframe_id, self._pose(last_id).compose(measured))
        self._update(graph, values)
        self._keyframe_ids.append(keyframe_id)

    def add_loop(self, loop: LoopConstraint) -> list[Verdict]:
        """Judge a loop; return its verdict and those of older loops that change with it.

        The live poses follow at once. Raises GraphError where an end is not in the graph.
        """
        return self._apply(self._arbiter.offer(loop))

    def settle(self) -> list[Verdict]:
        """Judge all loops once more together; return the verdicts that change."""
        changed = self._apply(self._arbiter.settle())
        self._relax(MAX_FINAL_UPDATES)
        return changed

    def estimate(self, keyframe_id: int) -> Transform:
        """Return the live ``T_world_lidar`` of a keyframe."""
        if keyframe_id not in self._arbiter.chain:
            raise GraphError(f"keyframe {keyframe_id} is not in the graph")
        return self._pose(keyframe_id).matrix()

    def estimates(self) -> dict[int, Transform]:
        """Return the live ``T_world_lidar`` of every keyframe, in the order they were added."""
        rows = gtsam.utilities.extractPose3(self._isam.calculateEstimate())  # by ascending key
        poses = np.tile(np.eye(4), (len(rows), 1, 1))
        poses[:, :3, :3], poses[:, :3, 3] = rows[:, :9].reshape(-1, 3, 3), rows[:, 9:]
        by_key = dict(zip(sorted(self._keyframe_ids), poses, strict=True))
        return {key: by_key[key] for key in self._keyframe_ids}

    def _pose(self, keyframe_id: int) -> gtsam.Pose3:
        return self._isam.calculateEstimatePose3(keyframe_id)

    def _apply(self, changed: Iterable[Verdict]) -> list[Verdict]:
        """Bring iSAM2 in line with the verdicts."""
        changed = list(changed)
        entering = [
            verdict
            for verdict in changed
            if verdict.status == "accepted" and verdict.index not in self._factor_ids
        ]
        leaving = [
            verdict.index
            for verdict in changed
            if verdict.status != "accepted" and verdict.index in self._factor_ids
        ]
        if not entering and not leaving:
            return changed
        graph = gtsam.NonlinearFactorGraph()
        for verdict in entering:
            loop = verdict.loop
            graph.add(
                between_factor(
                    Edge(loop.target_id, loop.query_id, loop.T_target_query, loop.information)
                )
            )
        removed = [self._factor_ids.pop(index) for index in leaving]
        result = self._update(graph, gtsam.Values(), removed, relinearize=True)
        for verdict, factor_id in zip(entering, result.getNewFactorsIndices(), strict=True):
            self._factor_ids[verdict.index] = int(factor_id)
        self._relax(NUM_EXTRA_UPDATES)
        return changed

    def _update(
        self,
        graph: gtsam.NonlinearFactorGraph | None = None,
        values: gtsam.Values | None = None,
        removed: Sequence[int] = (),
        relinearize: bool = False,
    ) -> gtsam.ISAM2Result:
        parameters = gtsam.ISAM2UpdateParams()
        parameters.removeFactorIndices = list(removed)
        parameters.force_relinearize = relinearize
        try:
            return self._isam.update(
                graph or gtsam.NonlinearFactorGraph(), values or gtsam.Values(), parameters
            )
        except RuntimeError as error:
            cause = " ".join(str(error).split(". ", 1)[0].split())
            raise GraphError(f"the pose graph cannot be solved: {cause}") from None

    def _relax(self, max_updates: int) -> None:
        """Let iSAM2 iterate: one update is one linearisation, and a loop moves much."""
        for _ in range(max_updates):
            if self._update(relinearize=True).getVariablesRelinearized() == 0:
                return

"""The plugin: line loops as factors for a GTSAM user who owns the graph and its solver.

    isam = gtsam.ISAM2()
    frontend = LineLoopFrontend(config, graph=isam.getFactorsUnsafe)
    for key, points, T_odom_lidar in keyframes:
        update = frontend.add_keyframe(key, points, T_odom_lidar)
        update.factors.push_back(my_factors)                   # odometry, GPS, IMU; any order
        isam.update(update.factors, update.initial, update.revoked)
        frontend.update_estimates(isam.calculateEstimate())    # optional: better candidates

``graph`` is how loops can be taken back: ``revoked`` holds indices into what it returns at that
moment, so nobody has to count factors or report them. It is only read.
"""

from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import TYPE_CHECKING, SupportsIndex

import gtsam
import numpy as np

from sl3d_slam.closing import LoopCloser
from sl3d_slam.config import SlamConfig
from sl3d_slam.errors import GraphError
from sl3d_slam.geometry.se3 import Points, Transform, invert
from sl3d_slam.graph.arbiter import LoopArbiter
from sl3d_slam.graph.ledger import FactorLedger
from sl3d_slam.graph.live_poses import LivePoses
from sl3d_slam.graph.loop_update import LoopUpdate, conclude
from sl3d_slam.graph.map_anchor import MapAnchor
from sl3d_slam.graph.noise import Matrix6, covariance_to_gtsam
from sl3d_slam.graph.rigid import rigid_transform
from sl3d_slam.graph.user_keys import MAP_ID, UserKeys, key_name
from sl3d_slam.graph.verdicts import Verdict
from sl3d_slam.io.points import checked_points, usable
from sl3d_slam.types import LoopConstraint, Rejection

if TYPE_CHECKING:
    from sl3d_slam.mapping.line_map import LineMap
    from sl3d_slam.relocalization.relocalizer import Relocalizer


class LineLoopFrontend:
    """Finds loops between the keyframes of a user's factor graph, judges them, hands over factors.

    It never optimises that graph. Its poses are those of the lidar; the user ties down its frame,
    by a prior or GPS.

    Parameters
    ----------
    config : as for the pipeline; ``config.graph`` holds the noise of the user's odometry.
    graph : returns the user's present graph, such as ``isam.getFactorsUnsafe``; only read, and
        needed to take loops back.
    odometry_factors : whether updates also hold a factor from the last keyframe to the new one.
    """

    def __init__(
        self,
        config: SlamConfig | None = None,
        graph: Callable[[], gtsam.NonlinearFactorGraph] | None = None,
        odometry_factors: bool = False,
    ) -> None:
        self._config = config or SlamConfig()
        self._odometry_factors = odometry_factors
        self._arbiter = LoopArbiter(self._config.graph)
        self._closer = LoopCloser(self._config, self._arbiter.chain)
        self._anchor = MapAnchor(self._arbiter.chain, self._config.graph)
        self._relocalizer: Relocalizer | None = None
        self._ledger = FactorLedger(graph)
        self._poses = LivePoses()
        self._keys = UserKeys()
        self._map_placed = False

    @property
    def verdicts(self) -> list[Verdict]:
        """Return what became of every verified loop so far, in the order they were found."""
        return [self._keys.verdict(verdict) for verdict in self._arbiter.verdicts]

    def add_keyframe(
        self,
        key: SupportsIndex,
        points_lidar: np.ndarray,
        T_odom_lidar: np.ndarray,
        num_scans_since_last: int = 1,
    ) -> LoopUpdate:
        """Take a keyframe, look for loops from it to earlier ones, return what follows.

        Parameters
        ----------
        key : any integer or ``gtsam.symbol``, in any order, each once.
        points_lidar : (N, 3) metres in the lidar frame, deskewed; points that are not finite or
            out of range are left out.
        T_odom_lidar : (4, 4) pose by the user's odometry, which may drift.
        num_scans_since_last : steps of odometry since the last keyframe; each adds its noise.

        Raises
        ------
        InputError, GraphError
            naming the key, for points that are no scan, a pose that is not rigid or a key that is
            taken; then nothing has changed.
        """
        number = self._keys.checked(key)
        name = f"keyframe {key_name(number)}"
        points = _scan(points_lidar, self._config, name)
        T_odom_new = _pose(T_odom_lidar, f"{name}'s odometry")
        view = self._closer.make_view(points)
        keyframe_id = len(self._poses)
        covariance = self._arbiter.add_keyframe(keyframe_id, T_odom_new, num_scans_since_last)
        self._closer.add(keyframe_id, view, T_odom_new)
        self._keys.add(keyframe_id, number)
        T_world_lidar = self._poses.add(keyframe_id, T_odom_new)
        update = self._search(keyframe_id, points)
        update.initial.insert(number, gtsam.Pose3(T_world_lidar))
        if self._odometry_factors and covariance is not None:
            update.factors.add(self._odometry_factor(keyframe_id, covariance))
        return update

    def add_loop(self, loop: LoopConstraint) -> LoopUpdate:
        """Judge a loop from elsewhere (a camera, a person) among the others.

        Its ids are keys that were added. Raises GraphError where one was not.
        """
        ends = self._keys.keyframe_id(loop.target_id), self._keys.keyframe_id(loop.query_id)
        inner = replace(loop, target_id=ends[0], query_id=ends[1])
        return self._conclude(self._arbiter.offer(inner), [])

    def settle(self) -> LoopUpdate:
        """Judge all loops once more together, best at the end of a run."""
        return self._conclude(self._arbiter.settle(), [])

    def update_estimates(self, values: gtsam.Values) -> None:
        """Take over the user's solution; keyframes that it leaves out move along with the others.

        Its other variables do not matter. Raises GraphError where it holds no keyframe.
        """
        known = {
            keyframe_id: np.asarray(values.atPose3(key).matrix())
            for keyframe_id, key in self._keys.keyframes().items()
            if values.exists(key)
        }
        if len(self._poses) and not known:
            newest = key_name(self._keys.key(len(self._poses) - 1))
            raise GraphError(f"the estimates hold no keyframe; expected poses such as {newest}")
        self._poses.update(known)

    def localize_against(self, line_map: "LineMap", map_key: SupportsIndex | None = None) -> None:
        """Look for every further keyframe in a saved map, too.

        Once enough relocalizations agree along the odometry, updates hold factors to the keyframes
        from ``map_key`` (``gtsam.symbol("m", 0)`` where None), whose pose is ``T_world_map``;
        ``initial`` holds it the first time. A user whose world is the map's frame says so by a
        prior of identity on it.

        Raises GraphError where the key is taken, InputError where the map cannot be searched.
        """
        from sl3d_slam.relocalization.relocalizer import Relocalizer

        if self._relocalizer is not None:
            raise GraphError("the keyframes are already looked for in a map; expected one map")
        number = self._keys.checked(int(gtsam.symbol("m", 0)) if map_key is None else map_key)
        self._relocalizer = Relocalizer(line_map, self._config)
        self._keys.add(MAP_ID, number)

    def _search(self, keyframe_id: int, points: Points) -> LoopUpdate:
        outcomes: list[LoopConstraint | Rejection] = []
        if self._config.loops.enabled:
            outcomes += self._closer.search(keyframe_id, self._poses.all())
        if self._relocalizer is not None:
            outcomes.append(self._in_map(self._relocalizer, keyframe_id, points))
        verdicts: list[Verdict] = []
        for outcome in outcomes:
            if isinstance(outcome, LoopConstraint):
                judge = self._anchor if outcome.target_id == MAP_ID else self._arbiter
                verdicts += judge.offer(outcome)
        return self._conclude(verdicts, [no for no in outcomes if isinstance(no, Rejection)])

    def _in_map(
        self, relocalizer: "Relocalizer", keyframe_id: int, points: Points
    ) -> LoopConstraint | Rejection:
        answer = relocalizer.relocalize(points)
        if answer.T_map_lidar is None:
            return Rejection(MAP_ID, keyframe_id, answer.reason)
        return LoopConstraint(
            MAP_ID, keyframe_id, answer.T_map_lidar, answer.information, answer.num_inliers
        )

    def _conclude(self, verdicts: Iterable[Verdict], rejections: list[Rejection]) -> LoopUpdate:
        """Express everything in the user's keys; place the map when its first factor goes out."""
        refused = map(self._keys.rejection, rejections)
        update = conclude(self._ledger, map(self._keys.verdict, verdicts), refused)
        if self._relocalizer is not None and not self._map_placed:
            map_key = self._keys.key(MAP_ID)
            for loop in [loop for loop in update.loops if loop.target_id == map_key][:1]:
                T_world_lidar = self._poses[self._keys.keyframe_id(loop.query_id)]
                T_world_map = T_world_lidar @ invert(loop.T_target_query)
                update.initial.insert(map_key, gtsam.Pose3(T_world_map))
                self._map_placed = True
        return update

    def _odometry_factor(self, keyframe_id: int, covariance: Matrix6) -> gtsam.BetweenFactorPose3:
        chain = self._arbiter.chain
        T_last_new = invert(chain.pose(keyframe_id - 1)) @ chain.pose(keyframe_id)
        keys = self._keys.key(keyframe_id - 1), self._keys.key(keyframe_id)
        noise = covariance_to_gtsam(covariance)
        return gtsam.BetweenFactorPose3(*keys, gtsam.Pose3(T_last_new), noise)


def _scan(points_lidar: np.ndarray, config: SlamConfig, name: str) -> Points:
    points = checked_points(points_lidar, name)
    return np.ascontiguousarray(points[usable(points, config.input, name)])


def _pose(T_a_b: np.ndarray, name: str) -> Transform:
    matrix = np.asarray(T_a_b, np.float64)
    if matrix.shape != (4, 4):
        raise GraphError(f"{name} has shape {matrix.shape}, expected a (4, 4) matrix in metres")
    return rigid_transform(matrix, name)

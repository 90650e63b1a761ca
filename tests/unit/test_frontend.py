"""The plugin with scripted loops: what it hands to a user's graph and takes back from it."""

from dataclasses import replace
from itertools import pairwise

import gtsam
import numpy as np
import pytest

from sl3d_slam.config import load_config
from sl3d_slam.errors import GraphError, InputError
from sl3d_slam.frontend import LineLoopFrontend
from sl3d_slam.geometry.se3 import distance_m, exp, from_yaw, invert
from sl3d_slam.types import LoopConstraint, Rejection, Relocalization

CONFIG = load_config()
TIGHT = np.diag(np.repeat([1e-3**-2, 0.01**-2], 3))  # 1 mrad, 1 cm: far better than the odometry
DRIFT = np.array([0.0002, -0.0001, 0.0005, 0.005, -0.003, 0.002])
WRONG = exp(np.array([0.0, 0.0, 0.03, 0.25, -0.2, 0.1]))  # within what drift could have done
POINTS = np.random.default_rng(1).uniform(3.0, 30.0, (200, 3))
NOISE = gtsam.noiseModel.Isotropic.Sigma(6, 0.05)


class ScriptedCloser:
    """Stands for the line stages: answers with the loops of a script."""

    def __init__(self, config):
        self.script = {}

    def make_view(self, points_lidar):
        return None

    def add(self, keyframe_id, view, T_odom_lidar):
        pass

    def search(self, query_id, estimates):
        self.estimates = estimates
        return self.script.get(query_id, [])


@pytest.fixture
def make_frontend(monkeypatch):
    """Return a maker of plugins that find exactly the given loops."""

    def make(loops=(), **options):
        closer = ScriptedCloser(CONFIG)
        for loop in loops:
            closer.script.setdefault(loop.query_id, []).append(loop)
        monkeypatch.setattr("sl3d_slam.frontend.LoopCloser", lambda config, chain: closer)
        return LineLoopFrontend(CONFIG, **options)

    return make


def square_drive(side=20):
    """Poses once around a square and 5 m into the second lap, 1 m apart, facing forwards."""
    poses = [from_yaw(0.3, np.array([3.0, -2.0, 1.0]))]
    for k in range(4 * side + 5):
        turn = np.pi / 2 if k % side == side - 1 else 0.0
        poses.append(poses[-1] @ from_yaw(turn, np.array([1.0, 0.0, 0.01])))
    return np.array(poses)


TRUTH = square_drive()


def drifted(truth):
    poses = [truth[0]]
    for before, after in pairwise(truth):
        poses.append(poses[-1] @ invert(before) @ after @ exp(DRIFT))
    return np.array(poses)


ODOMETRY = drifted(TRUTH)


def true_loop(target, query):
    T_target_query = invert(TRUTH[target]) @ TRUTH[query]
    return LoopConstraint(target, query, T_target_query, TIGHT, num_inliers=9)


def wrong_loop(target, query):
    loop = true_loop(target, query)
    return replace(loop, T_target_query=loop.T_target_query @ WRONG)


def names():
    """Symbols whose numbers fall and whose letters alternate: keys that never were monotone."""
    return [gtsam.symbol("xa"[k % 2], 5000 - 7 * k) for k in range(len(TRUTH))]


class User:
    """Somebody with an iSAM2, a prior, odometry and GPS of their own."""

    def __init__(self, make_frontend, loops, keys):
        self.isam = gtsam.ISAM2()
        self.frontend = make_frontend(loops, graph=self.isam.getFactorsUnsafe)
        self.keys = keys
        self.updates = []

    def drive(self):
        """Drive on, to the end or until a factor has just been removed."""
        for k in range(len(self.updates), len(TRUTH)):
            T = ODOMETRY[k]
            update = self.frontend.add_keyframe(self.keys[k], POINTS, T)
            mine = gtsam.NonlinearFactorGraph()
            if k == 0:
                mine.add(gtsam.PriorFactorPose3(self.keys[0], gtsam.Pose3(T), NOISE))
            else:
                step = gtsam.Pose3(invert(ODOMETRY[k - 1]) @ T)
                ends = self.keys[k - 1], self.keys[k]
                mine.add(gtsam.BetweenFactorPose3(*ends, step, NOISE))
            if k % 3 == 0:  # so that nobody's count of factors is that of the plugin
                gps = gtsam.noiseModel.Isotropic.Sigma(3, 50.0)
                mine.add(gtsam.GPSFactor(self.keys[k], TRUTH[k, :3, 3], gps))
            mine.push_back(update.factors)
            self.removed = [self.isam.getFactorsUnsafe().at(i) for i in update.revoked]
            self.isam.update(mine, update.initial, update.revoked)
            self.isam.update()
            self.frontend.update_estimates(self.isam.calculateEstimate())
            self.updates.append(update)
            if self.removed:
                break
        return self

    def last_error_m(self):
        newest = len(self.updates) - 1
        estimate = self.isam.calculateEstimatePose3(self.keys[newest]).matrix()
        return distance_m(invert(TRUTH[newest]) @ estimate)


TRUE_LOOPS = [true_loop(k - 80, k) for k in range(81, 86)]


def test_a_users_own_isam_follows_the_loops(make_frontend):
    without = User(make_frontend, [], names()).drive()
    user = User(make_frontend, TRUE_LOOPS, names()).drive()
    assert without.last_error_m() > 0.3
    assert user.last_error_m() < 0.1 * without.last_error_m()


def test_a_loop_factor_points_from_target_to_query_in_the_users_keys(make_frontend):
    keys = names()
    user = User(make_frontend, TRUE_LOOPS, keys).drive()
    (update,) = [u for u in user.updates if u.loops and u.loops[0].query_id == keys[83]]
    (factor,) = [update.factors.at(k) for k in range(update.factors.size())]
    assert list(factor.keys()) == [keys[3], keys[83]]
    assert update.loops[0].target_id == keys[3]
    values = gtsam.Values()
    values.insert(keys[3], gtsam.Pose3(TRUTH[3]))
    values.insert(keys[83], gtsam.Pose3(TRUTH[83]))
    assert factor.error(values) < 1e-15
    T_3_83 = invert(TRUTH[3]) @ TRUTH[83]
    assert distance_m(T_3_83 @ T_3_83) > 1.0  # not its own inverse, so a swapped pair would show
    # information is rotation first, at the query: 1 cm ahead of the query is one sigma
    values.update(keys[83], gtsam.Pose3(TRUTH[83] @ exp(np.array([0, 0, 0, 0.01, 0, 0]))))
    assert 2 * factor.error(values) == pytest.approx(1.0, rel=1e-6)


def test_a_wrong_early_loop_leaves_by_its_index_and_the_drive_recovers(make_frontend):
    loops = [wrong_loop(0, 80), *TRUE_LOOPS]
    user = User(make_frontend, loops, names()).drive()
    early = user.updates[80]
    assert [loop.query_id for loop in early.loops] == [user.keys[80]]
    (removed,) = user.removed
    assert list(removed.keys()) == [user.keys[0], user.keys[80]]
    assert removed.measured().equals(gtsam.Pose3(loops[0].T_target_query), 1e-12)
    (gone,) = user.updates[-1].taken_back
    assert (gone.target_id, gone.query_id) == (user.keys[0], user.keys[80])
    assert "contradicts" in gone.reason
    user.drive()
    assert user.last_error_m() < 0.05
    statuses = {v.loop.query_id: v.status for v in user.frontend.verdicts}
    assert statuses.pop(user.keys[80]) == "revoked"
    assert set(statuses.values()) == {"accepted"}


def test_a_factor_that_waits_to_be_added_is_named_once_it_is_there(make_frontend):
    graph = gtsam.NonlinearFactorGraph()
    frontend = make_frontend([wrong_loop(0, 80), *TRUE_LOOPS], graph=lambda: graph)
    held = gtsam.NonlinearFactorGraph()
    for k in range(len(TRUTH) - 1):
        update = frontend.add_keyframe(k, POINTS, ODOMETRY[k])
        held.push_back(update.factors)
        assert update.revoked == []
    assert any(v.status == "revoked" for v in frontend.verdicts)
    graph.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(), NOISE))
    graph.push_back(held)
    (index,) = frontend.add_keyframe(len(TRUTH) - 1, POINTS, ODOMETRY[-1]).revoked
    assert list(graph.at(index).keys()) == [0, 80]
    assert frontend.settle().revoked == []  # named once


def test_taking_back_without_a_graph_is_an_error_and_never_a_guess(make_frontend):
    frontend = make_frontend([wrong_loop(0, 80), *TRUE_LOOPS])
    updates = [frontend.add_keyframe(k, POINTS, T) for k, T in enumerate(ODOMETRY)]
    (with_loss,) = [update for update in updates if update.taken_back]
    assert updates[80].revoked == []
    with pytest.raises(GraphError, match=r"graph=isam\.getFactorsUnsafe"):
        _ = with_loss.revoked


def test_rejections_carry_keys_and_reasons(make_frontend):
    weak = replace(true_loop(3, 83), information=np.diag([0.0, 0.0, 1e4, 1e4, 1e4, 0.0]))
    far = replace(true_loop(4, 84), T_target_query=exp(np.array([0, 0, 1.0, 30.0, 0, 0])))
    seen = Rejection(5, 85, "only 3 lines agree", np.eye(4), 3)
    keys = names()
    user = User(make_frontend, [weak, far, seen], keys).drive()
    found = {no.query_id: no for update in user.updates for no in update.rejected}
    assert {no.target_id for no in found.values()} == {keys[3], keys[4], keys[5]}
    assert "leaves 3 of 6 directions free" in found[keys[83]].reason
    assert "contradicts the odometry" in found[keys[84]].reason
    assert found[keys[85]].reason == "only 3 lines agree"
    assert all(update.factors.size() == 0 and not update.loops for update in user.updates)


def test_a_loop_of_ones_own_is_judged_with_the_others(make_frontend):
    frontend = make_frontend()
    keys = names()
    for key, T in zip(keys, ODOMETRY, strict=True):
        frontend.add_keyframe(key, POINTS, T)
    loop = replace(true_loop(2, 84), target_id=keys[2], query_id=keys[84])
    update = frontend.add_loop(loop)
    assert list(update.factors.at(0).keys()) == [keys[2], keys[84]]
    assert update.initial.size() == 0
    with pytest.raises(GraphError, match="key x77 is no keyframe"):
        frontend.add_loop(replace(loop, query_id=gtsam.symbol("x", 77)))


def test_odometry_factors_come_on_request_only(make_frontend):
    for wanted in (False, True):
        frontend = make_frontend(odometry_factors=wanted)
        first = frontend.add_keyframe(9, POINTS, ODOMETRY[18])
        second = frontend.add_keyframe(4, POINTS, ODOMETRY[22], num_scans_since_last=4)
        assert first.factors.size() == 0
        assert second.factors.size() == int(wanted)
    factor = second.factors.at(0)
    assert list(factor.keys()) == [9, 4]
    values = gtsam.Values()
    values.insert(9, gtsam.Pose3(ODOMETRY[18]))
    values.insert(4, gtsam.Pose3(ODOMETRY[22]))
    assert factor.error(values) < 1e-15


def test_initial_values_follow_the_users_solution_and_frame(make_frontend):
    frontend = make_frontend()
    for k in range(3):
        update = frontend.add_keyframe(k, POINTS, ODOMETRY[k])
        np.testing.assert_allclose(update.initial.atPose3(k).matrix(), ODOMETRY[k], atol=1e-12)
    T_enu_odom = exp(np.array([0.1, -0.2, 1.9, 400.0, -30.0, 7.0]))
    values = gtsam.Values()
    values.insert(1, gtsam.Pose3(T_enu_odom @ ODOMETRY[1]))  # the user's window has left 0 and 2
    values.insert(gtsam.symbol("b", 1), np.zeros(3))  # a variable of the user's own
    frontend.update_estimates(values)
    update = frontend.add_keyframe(3, POINTS, ODOMETRY[3])
    expected = T_enu_odom @ ODOMETRY[3]
    np.testing.assert_allclose(update.initial.atPose3(3).matrix(), expected, atol=1e-9)
    for k, pose in frontend._closer.estimates.items():  # candidates see all in the user's frame
        np.testing.assert_allclose(pose, T_enu_odom @ ODOMETRY[k], atol=1e-9)
    with pytest.raises(GraphError, match="hold no keyframe; expected poses such as 3"):
        frontend.update_estimates(gtsam.Values())


@pytest.mark.parametrize(
    ("key", "points", "pose", "error", "complaint"),
    [
        (gtsam.symbol("x", 3), POINTS, TRUTH[1], GraphError, "key x3 was added before"),
        (-4, POINTS, TRUTH[1], GraphError, "key -4: expected 0 to"),
        (8, POINTS[:, :2], TRUTH[1], InputError, r"keyframe 8: points have shape \(200, 2\)"),
        (8, np.full((500, 3), np.nan), TRUTH[1], InputError, "keyframe 8: 0 of 500 points"),
        (8, POINTS[:40], TRUTH[1], InputError, "keyframe 8: 40 of 40 points"),
        (8, POINTS, TRUTH[1][:3], GraphError, r"keyframe 8's odometry has shape \(3, 4\)"),
        (8, POINTS, 2 * np.eye(4), GraphError, "keyframe 8's odometry.*not a rotation"),
        (8, POINTS, np.full((4, 4), np.inf), GraphError, "keyframe 8's odometry.*not finite"),
    ],
)
def test_nonsense_is_named_and_changes_nothing(make_frontend, key, points, pose, error, complaint):
    frontend = make_frontend(odometry_factors=True)
    frontend.add_keyframe(gtsam.symbol("x", 3), POINTS, TRUTH[0])
    with pytest.raises(error, match=complaint):
        frontend.add_keyframe(key, points, pose)
    update = frontend.add_keyframe(8, POINTS, TRUTH[1])
    assert list(update.factors.at(0).keys()) == [gtsam.symbol("x", 3), 8]


class ScriptedRelocalizer:
    """Knows the map, T_map_odom applied to the truth, but errs at some keyframes."""

    T_map_world = exp(np.array([0.05, -0.1, 2.4, 60.0, -35.0, 4.0]))
    lost, wrong = {2, 3}, {6}

    def __init__(self, line_map, config):
        self.calls = -1

    def relocalize(self, points_lidar):
        self.calls += 1
        if self.calls in self.lost:
            return Relocalization(False, None, np.zeros((6, 6)), 0, 0.0, "no lines")
        T_map_lidar = self.T_map_world @ TRUTH[self.calls]
        if self.calls in self.wrong:
            T_map_lidar = T_map_lidar @ from_yaw(0.0, np.array([20.0, 0.0, 0.0]))
        return Relocalization(True, T_map_lidar, TIGHT, 8, 0.9)


def test_a_saved_map_gets_a_frame_of_its_own(make_frontend, monkeypatch):
    monkeypatch.setattr("sl3d_slam.relocalization.relocalizer.Relocalizer", ScriptedRelocalizer)
    frontend = make_frontend(odometry_factors=True)
    frontend.localize_against(None, map_key=gtsam.symbol("m", 7))
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    updates = []
    for k in range(10):
        updates.append(frontend.add_keyframe(k, POINTS, ODOMETRY[k]))
        graph.push_back(updates[-1].factors)
        values.insert(updates[-1].initial)
    # 0, 1 and 4 are the first three that agree; the map's frame comes with them
    placed = [k for k, update in enumerate(updates) if update.initial.exists(gtsam.symbol("m", 7))]
    assert placed == [4]
    assert {loop.query_id for update in updates for loop in update.loops} == {0, 1, 4, 5, 7, 8, 9}
    refused = {no.query_id: no.reason for update in updates for no in update.rejected}
    assert refused[2] == "no lines"
    assert "contradicts 4 relocalizations" in refused[6]
    T_world_map = invert(ScriptedRelocalizer.T_map_world)
    # prior and relocalizations are exact; only the odometry's drift of 6 mm a step disagrees
    first = updates[4].initial.atPose3(gtsam.symbol("m", 7)).matrix()
    np.testing.assert_allclose(first, T_world_map, atol=0.1)  # 60 m away: 1 mrad is 6 cm
    graph.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(TRUTH[0]), NOISE))
    solution = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    found = solution.atPose3(gtsam.symbol("m", 7)).matrix()
    np.testing.assert_allclose(found, T_world_map, atol=0.1)  # for the same reason
    with pytest.raises(GraphError, match="expected one map"):
        frontend.localize_against(None)


def test_the_key_of_a_map_must_be_new(make_frontend, monkeypatch):
    monkeypatch.setattr("sl3d_slam.relocalization.relocalizer.Relocalizer", ScriptedRelocalizer)
    frontend = make_frontend()
    frontend.add_keyframe(gtsam.symbol("m", 0), POINTS, ODOMETRY[0])
    with pytest.raises(GraphError, match="key m0 was added before"):
        frontend.localize_against(None)

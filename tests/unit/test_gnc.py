import numpy as np
import pytest

from sl3d_slam.bench.backend_world import built_in_drive, make_world
from sl3d_slam.config import GraphSettings
from sl3d_slam.graph.chain import OdometryChain
from sl3d_slam.graph.consistency import stack_loops
from sl3d_slam.graph.final import odometry_edges
from sl3d_slam.graph.outliers import gnc_tls
from sl3d_slam.graph.peers import solve_with_gnc
from sl3d_slam.graph.solve import Edge

TRUTH = built_in_drive(2000)[::5]  # 400 poses 5 m apart


def columns(world):
    """Return the odometry chain, the loops as columns and which of them are true."""
    chain = OdometryChain(GraphSettings())
    for k, pose in enumerate(world.T_odom_lidar):
        chain.append(k, pose, 1)
    return chain, stack_loops(chain, world.loops), np.array(world.is_true)


@pytest.fixture(scope="module")
def contest():
    return columns(make_world(TRUTH, 40, 0.2, "random", seed=3))


def test_from_a_good_belief_gnc_finds_the_true_loops(contest):
    chain, loops, is_true = contest
    believed = is_true.copy()
    believed[np.flatnonzero(is_true)[::2]] = False  # told only half of them
    result = gnc_tls(chain, loops, believed, 1e-3)
    np.testing.assert_array_equal(result.inliers, is_true)
    assert np.all(result.squared[is_true] <= result.threshold)
    assert np.all(result.squared[~is_true] > result.threshold)


def test_gnc_drops_wrong_loops_that_it_was_told_to_believe(contest):
    chain, loops, is_true = contest
    result = gnc_tls(chain, loops, np.ones(len(is_true), dtype=bool), 1e-3)
    np.testing.assert_array_equal(result.inliers, is_true)


def test_gnc_over_the_loop_ends_agrees_with_gtsam_s_over_all_poses():
    world = make_world(TRUTH[:250], 30, 0.1, "random", seed=3)
    chain, loops, is_true = columns(world)
    edges = [
        Edge(loop.target_id, loop.query_id, loop.T_target_query, loop.information)
        for loop in world.loops
    ]
    odometry = odometry_edges(world.T_odom_lidar, GraphSettings())
    _, theirs = solve_with_gnc(world.T_odom_lidar, odometry, edges, 1e-3)
    ours = gnc_tls(chain, loops, np.ones(len(is_true), dtype=bool), 1e-3)
    np.testing.assert_array_equal(ours.inliers, theirs > 0.5)
    np.testing.assert_array_equal(ours.inliers, is_true)


def test_honest_loops_are_kept_at_the_stated_rate():
    kept = []
    for seed in range(2):
        chain, loops, _ = columns(make_world(TRUTH, 60, 0.0, "random", seed))
        kept.append(gnc_tls(chain, loops, np.ones(60, dtype=bool), 0.01).inliers.mean())
    # 120 loops at 1 %: 1.2 are lost on average, 6 would be over 4 standard deviations more
    assert np.mean(kept) > 1.0 - 6 / 120

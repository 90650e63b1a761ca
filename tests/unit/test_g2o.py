import gtsam
import numpy as np
import pytest

from sl3d_slam.config import GraphSettings
from sl3d_slam.errors import InputError
from sl3d_slam.geometry.se3 import exp, from_yaw, invert
from sl3d_slam.graph.final import optimise_all_scans
from sl3d_slam.graph.g2o import G2oGraph, format_g2o, read_g2o
from sl3d_slam.graph.solve import Edge, Prior, anchor, optimise
from sl3d_slam.types import LoopConstraint

# T_world_1 turns x to y, y to z, z to x (120 deg about (1, 1, 1)) at (1, 2, 3). The information
# is diag(1..6), rotation first, with 0.5 between rotation x (0) and translation z (5): in g2o's
# order (x y z, then rotation) the diagonal is 4 5 6 1 2 3 and the 0.5 stands in the row of z.
TURN = np.array([[0.0, 0, 1, 1], [1, 0, 0, 2], [0, 1, 0, 3], [0, 0, 0, 1]])
MIXED = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
MIXED[0, 5] = MIXED[5, 0] = 0.5
GOLDEN = """\
VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1
VERTEX_SE3:QUAT 1 1 2 3 0.5 0.5 0.5 0.5
FIX 0
PARAMS_SE3OFFSET 0 0 0 0 0 0 0 1
EDGE_SE3_PRIOR 1 0 1 2 3 0.5 0.5 0.5 0.5 \
4 0 0 0 0 0 5 0 0 0 0 6 0.5 0 0 1 0 0 2 0 3
EDGE_SE3:QUAT 0 1 1 2 3 0.5 0.5 0.5 0.5 \
4 0 0 0 0 0 5 0 0 0 0 6 0.5 0 0 1 0 0 2 0 3
"""


def golden_graph():
    return G2oGraph(
        poses={0: np.eye(4), 1: TURN},
        edges=[Edge(0, 1, TURN, MIXED)],
        priors=[Prior(1, TURN, MIXED)],
        fixed=[0],
    )


def random_graph(rng):
    keys = [3, gtsam.symbol("a", 5), gtsam.symbol("b", 5), 17]
    poses = {key: exp(rng.standard_normal(6) * 2) for key in keys}
    informations = [A @ A.T + np.eye(6) for A in rng.standard_normal((5, 6, 6))]
    edges = [
        Edge(a, b, invert(poses[a]) @ poses[b] @ exp(0.1 * rng.standard_normal(6)), information)
        for a, b, information in zip(keys, np.roll(keys, 1).tolist(), informations, strict=False)
    ]
    prior = Prior(keys[1], poses[keys[1]], informations[-1])
    return G2oGraph(poses, edges, [prior], [3])


def written(tmp_path, graph):
    path = tmp_path / "graph.g2o"
    path.write_text(format_g2o(graph), encoding="ascii")
    return path


def test_golden_file():
    assert format_g2o(golden_graph()) == GOLDEN


def test_golden_file_is_read(tmp_path):
    path = tmp_path / "graph.g2o"
    path.write_text("# by hand\n\n" + GOLDEN.replace(" ", "  ").replace("\n", "\r\n"))
    graph = read_g2o(path)
    assert list(graph.poses) == [0, 1]
    assert graph.fixed == [0]
    for pose in (graph.poses[1], graph.edges[0].T_first_second, graph.priors[0].T_world_key):
        np.testing.assert_allclose(pose, TURN, atol=1e-15)
    np.testing.assert_array_equal(graph.edges[0].information, MIXED)
    np.testing.assert_array_equal(graph.priors[0].information, MIXED)


def test_what_is_written_is_read_back(tmp_path, rng):
    graph = random_graph(rng)
    again = read_g2o(written(tmp_path, graph))
    assert list(again.poses) == list(graph.poses)
    assert again.fixed == graph.fixed
    for key, pose in graph.poses.items():
        np.testing.assert_allclose(again.poses[key], pose, atol=1e-14)
    for mine, theirs in zip(graph.edges, again.edges, strict=True):
        assert (mine.first, mine.second) == (theirs.first, theirs.second)
        np.testing.assert_allclose(theirs.T_first_second, mine.T_first_second, atol=1e-14)
        np.testing.assert_array_equal(theirs.information, mine.information)
    np.testing.assert_array_equal(again.priors[0].information, graph.priors[0].information)


def test_gtsam_reads_the_same_graph(tmp_path, rng):
    graph = random_graph(rng)
    factors, values = gtsam.readG2o(str(written(tmp_path, graph)), True)
    assert sorted(values.keys()) == sorted(graph.poses)  # symbols of one index stay apart
    assert factors.size() == len(graph.edges)
    for k, edge in enumerate(graph.edges):
        factor = factors.at(k)
        assert list(factor.keys()) == [edge.first, edge.second]
        np.testing.assert_allclose(factor.measured().matrix(), edge.T_first_second, atol=1e-12)
        np.testing.assert_allclose(
            factor.noiseModel().information(), edge.information, rtol=1e-9, atol=1e-9
        )


def test_two_sessions_with_the_same_indices_stay_apart(tmp_path):
    a, b = gtsam.symbol("a", 0), gtsam.symbol("b", 0)
    graph = G2oGraph({a: np.eye(4), b: TURN}, [Edge(a, b, TURN, np.eye(6))])
    assert list(read_g2o(written(tmp_path, graph)).poses) == [a, b]


def solved_loop():
    steps = [from_yaw(2 * np.pi / 12 + 0.01, np.array([1.0, 0.05, 0.02]))] * 14
    odometry = [from_yaw(0.4, np.array([5.0, 6.0, 7.0]))]
    for step in steps:
        odometry.append(odometry[-1] @ step)
    same = {k: k for k in range(15)}
    loop = LoopConstraint(1, 14, exp(np.array([0, 0, 0.5, 1.0, 0.3, 0])), 1e4 * np.eye(6), 9)
    return optimise_all_scans(np.array(odometry), same, {}, [loop], GraphSettings())


def test_a_run_s_file_reopens_to_the_same_solution(tmp_path):
    final = solved_loop()
    path = tmp_path / "graph.g2o"
    path.write_text(final.to_g2o(), encoding="ascii")
    graph = read_g2o(path)
    assert len(graph.edges) == 15
    held = [anchor(key, graph.poses[key]) for key in graph.fixed]
    _, values = optimise(graph.poses, graph.edges, held)
    for key, pose in final.poses.items():
        np.testing.assert_allclose(values.atPose3(key).matrix(), pose, atol=1e-6)


def test_gtsam_reopens_a_run_s_file_to_the_same_solution(tmp_path):
    final = solved_loop()
    path = tmp_path / "graph.g2o"
    path.write_text(final.to_g2o(), encoding="ascii")
    factors, values = gtsam.readG2o(str(path), True)
    held = gtsam.noiseModel.Isotropic.Sigma(6, 1e-4)
    factors.add(gtsam.PriorFactorPose3(0, values.atPose3(0), held))
    moved = gtsam.Values(values)
    moved.update(7, values.atPose3(7).compose(gtsam.Pose3(TURN)))  # start elsewhere
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-14)
    solution = gtsam.LevenbergMarquardtOptimizer(factors, moved, parameters).optimize()
    for key, pose in final.poses.items():
        np.testing.assert_allclose(solution.atPose3(key).matrix(), pose, atol=1e-6)


EDGE = GOLDEN.splitlines()[-1]
BOTH = "\n".join(GOLDEN.splitlines()[:2]) + "\n"


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("", "no VERTEX_SE3:QUAT"),
        ("VERTEX_SE2 0 0 0 0\n", "line 1: unknown tag 'VERTEX_SE2'"),
        ("VERTEX_SE3:QUAT 0 0 0 0 0 0 0\n", "line 1: 7 fields after the tag, expected 8"),
        ("VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1 1\n", "line 1: 9 fields after the tag, expected 8"),
        ("VERTEX_SE3:QUAT -1 0 0 0 0 0 0 1\n", "line 1: key '-1'"),
        ("VERTEX_SE3:QUAT 1.5 0 0 0 0 0 0 1\n", "line 1: key '1.5'"),
        ("VERTEX_SE3:QUAT 18446744073709551616 0 0 0 0 0 0 1\n", "at most 64 bits"),
        (f"VERTEX_SE3:QUAT {'9' * 5000} 0 0 0 0 0 0 1\n", "at most 64 bits"),
        ("VERTEX_SE3:QUAT 0 nan 0 0 0 0 0 1\n", "line 1: a number is not finite"),
        ("VERTEX_SE3:QUAT 0 0 0 1e999 0 0 0 1\n", "line 1: a number is not finite"),
        ("VERTEX_SE3:QUAT 0 x 0 0 0 0 0 1\n", "line 1: could not convert string to float: 'x'"),
        ("VERTEX_SE3:QUAT 0 0 0 0 0 0 0 0\n", "line 1: the quaternion"),
        ("VERTEX_SE3:QUAT 0 0 0 0 0 0 1 1\n", "line 1: the quaternion"),
        (BOTH + "VERTEX_SE3:QUAT 1 0 0 0 0 0 0 1\n", "line 3: vertex 1 is given twice"),
        (BOTH + EDGE.replace("QUAT 0 1", "QUAT 0 7"), "line 3: key 7 has no VERTEX_SE3:QUAT"),
        (BOTH + EDGE + " 1\n", "line 3: 31 fields after the tag, expected 30"),
        (BOTH + "FIX 9\n", "line 3: key 9 has no VERTEX_SE3:QUAT"),
        (BOTH + "PARAMS_SE3OFFSET 0 1 0 0 0 0 0 1\n", "line 3: a sensor offset"),
        (
            BOTH + EDGE.replace("EDGE_SE3:QUAT 0 1", "EDGE_SE3_PRIOR 0 1"),
            "line 3: prior with sensor",
        ),
        ("VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1 \u00e9\n", "not text"),
    ],
)
def test_a_damaged_file_is_refused_by_line(tmp_path, text, complaint):
    path = tmp_path / "broken.g2o"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError) as refused:
        read_g2o(path)
    assert str(refused.value).startswith(f"{path}: ")
    assert complaint in str(refused.value)


def test_a_missing_file_or_folder_is_named(tmp_path):
    for path in (tmp_path / "none.g2o", tmp_path):
        with pytest.raises(InputError, match="cannot be read as a g2o file"):
            read_g2o(path)


def test_a_vertex_may_follow_its_edge(tmp_path):
    path = tmp_path / "late.g2o"
    path.write_text(EDGE + "\n" + BOTH)
    assert len(read_g2o(path).edges) == 1

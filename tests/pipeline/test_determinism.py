"""The same scans give the same run, bit for bit: from the command line, with lines found beside
odometry, and from Python, one after the other.
"""

import json

import numpy as np
import pytest

from sl3d_slam import LineMap, SlamPipeline, load_config
from sl3d_slam.graph.g2o import read_g2o


@pytest.fixture(scope="module")
def again(ring_dataset):
    """A second run, all in this process; the first one had a worker."""
    slam = SlamPipeline(load_config(), simulated=True)
    for scan in ring_dataset:
        slam.process(scan)
    return slam.finish()


def test_poses_are_bitwise_the_same(ring_run, again):
    """The g2o file holds 17 digits, enough for every bit of a translation."""
    stored = read_g2o(ring_run / "graph.g2o").poses
    for key, pose in enumerate(again.trajectory.T_world_lidar):
        np.testing.assert_array_equal(stored[key][:3, 3], pose[:3, 3])
    assert again.graph_g2o == (ring_run / "graph.g2o").read_text()


def test_loops_and_map_are_bitwise_the_same(ring_run, again, tmp_path):
    stored = json.loads((ring_run / "loops.json").read_text())
    assert [loop.T_target_query.tolist() for loop in again.loops] == [
        loop["T_target_query"] for loop in stored
    ]
    assert [loop.status for loop in again.loops] == [loop["status"] for loop in stored]
    again.line_map.save(tmp_path / "map.sl3d")
    first, second = (LineMap.load(path / "map.sl3d") for path in (ring_run, tmp_path))
    np.testing.assert_array_equal(first.lines.endpoints, second.lines.endpoints)
    origin = np.zeros(3)
    np.testing.assert_array_equal(first.cloud_near(origin, 50.0), second.cloud_near(origin, 50.0))

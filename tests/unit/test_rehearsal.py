"""After the rehearsal nothing is left to be compiled, whatever the scans hold."""

import subprocess
import sys

import pytest

SCRIPT = """
import sys
from unittest.mock import patch
import numpy as np
from numba.core.registry import CPUDispatcher
from sl3d_slam.closing import LoopCloser
from sl3d_slam.config import load_config
from sl3d_slam.graph.chain import OdometryChain
from sl3d_slam.lines.extract import LineExtractor
from sl3d_slam.lines.network.answer import Inference
from sl3d_slam.lines.network.inference import Network
from sl3d_slam.loops.triangle_table import must_compile
from sl3d_slam.rehearsal import rehearse_constellations, rehearse_keyframes

def compiled():
    return {
        (name, function, str(signature))
        for name, module in sys.modules.items() if name.startswith("sl3d_slam")
        for function, value in vars(module).items() if isinstance(value, CPUDispatcher)
        for signature in value.signatures
    }

infer = Network.infer
def infer_doubtfully(network, points):
    inference = infer(network, points)
    return Inference(np.full_like(inference.probability, 0.01), inference.describe)

config = load_config(None, [sys.argv[1]])
with patch.object(Network, "infer", infer_doubtfully):  # other weights' opinion of the corner
    rehearse_keyframes(LineExtractor(config.lines), config)
rehearse_constellations()
assert not must_compile()
before = compiled()
chain = OdometryChain(config.graph)
closer = LoopCloser(config, chain)
for keyframe_id, path in enumerate(sys.argv[2:]):
    points = np.fromfile(path, np.float32).reshape(-1, 4)[:, :3].astype(float)
    T_odom_lidar = np.eye(4)
    T_odom_lidar[0, 3] = 100.0 * keyframe_id
    chain.append(keyframe_id, T_odom_lidar, 50)
    closer.add(keyframe_id, closer.make_view(points), T_odom_lidar)
    here = {other_id: np.eye(4) for other_id in range(keyframe_id + 1)}
    found = closer.search(keyframe_id, {}) + closer.search(keyframe_id, here)
print(len(before), len(found), compiled() - before)
"""


@pytest.mark.parametrize("method", ["geometric", "learned"])
def test_scans_leave_nothing_to_compile_after_the_rehearsal(ring_folder, method):
    scans = sorted(ring_folder.rglob("velodyne/*.bin"))
    chosen = [str(scans[index]) for index in (2, 20, 46)]
    command = [sys.executable, "-c", SCRIPT, f"lines.method={method}", *chosen]
    answer = subprocess.run(command, capture_output=True, text=True, check=True)
    num_before, num_found, new = answer.stdout.split(maxsplit=2)
    assert int(num_before) > 40
    assert int(num_found) > 0
    assert new.strip() == "set()"

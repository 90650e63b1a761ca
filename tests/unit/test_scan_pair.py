"""Two scans are registered by geometry's lines where those are sure, else by the network's."""

import numpy as np
import pytest

from sl3d_slam import scan_pair
from sl3d_slam.config import SlamConfig, load_config
from sl3d_slam.geometry.se3 import from_yaw, invert
from sl3d_slam.lines.extract import LineExtractor
from sl3d_slam.lines.network.inference import Network
from sl3d_slam.registration import register_lines
from sl3d_slam.scan_pair import PairRegistrar


@pytest.fixture(scope="module")
def pair(ring_dataset):
    """Two scans 8 m apart, the first one's sensor turned, and ``T_target_source``."""
    source, target = (next(ring_dataset.iterate(k, k + 1)).points_lidar for k in (8, 4))
    T_turned_lidar = from_yaw(2.0, np.zeros(3))
    T_truth = invert(ring_dataset.truth[4]) @ ring_dataset.truth[8] @ invert(T_turned_lidar)
    return source @ T_turned_lidar[:3, :3].T, target, T_truth


def asked_of(monkeypatch):
    asked = []
    infer = Network.infer
    monkeypatch.setattr(Network, "infer", lambda *given: asked.append(1) or infer(*given))
    return asked


def test_the_network_is_not_asked_where_geometry_is_sure(pair, monkeypatch):
    source, target, T_truth = pair
    asked = asked_of(monkeypatch)
    answer = PairRegistrar(SlamConfig()).register(source, target)
    assert answer.registration.success
    np.testing.assert_allclose(answer.registration.T_target_source, T_truth, atol=0.1)
    assert asked == []


def test_the_networks_lines_decide_where_geometry_is_not_sure(pair, monkeypatch):
    source, target, T_truth = pair
    asked = asked_of(monkeypatch)
    monkeypatch.setattr(scan_pair, "LACKING_LOG_ODDS", -1e9)
    answer = PairRegistrar(SlamConfig()).register(source, target)
    assert len(asked) == 2
    np.testing.assert_allclose(answer.registration.T_target_source, T_truth, atol=0.1)
    learned = [LineExtractor().extract(points) for points in (source, target)]
    for lines, expected in zip(answer.lines, learned, strict=True):
        np.testing.assert_array_equal(lines.endpoints, expected.endpoints)
    alone = register_lines(*learned, (source, target))
    np.testing.assert_array_equal(answer.registration.T_target_source, alone.T_target_source)


def test_what_settings_want_is_wanted_of_both(pair, monkeypatch):
    asked = asked_of(monkeypatch)
    config = load_config(None, ["matching.min_log_odds=1e9"])
    answer = PairRegistrar(config).register(*pair[:2])
    assert len(asked) == 2
    assert not answer.registration.success
    assert answer.registration.reason


def test_the_geometric_method_never_loads_a_network(pair, monkeypatch):
    asked = asked_of(monkeypatch)
    registrar = PairRegistrar(load_config(None, ["lines.method=geometric"]))
    for way in (registrar.register, registrar.register_by_lines):
        assert way(*pair[:2]).registration.success
    assert asked == []

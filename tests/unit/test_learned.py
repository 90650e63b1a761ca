"""The learned extractor: what it takes from the network and what must hold whatever its weights."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from sl3d_slam.config import LineSettings
from sl3d_slam.errors import InputError, MissingExtraError
from sl3d_slam.geometry.se3 import from_yaw, make_transform, transform_points
from sl3d_slam.lines import extract
from sl3d_slam.lines.extract import LineExtractor
from sl3d_slam.lines.grown import grow_uprights
from sl3d_slam.lines.learned import points_along
from sl3d_slam.lines.network.inference import Network
from sl3d_slam.lines.network.model import SuperLine3D
from sl3d_slam.lines.network.sample import network_points
from sl3d_slam.lines.network.settings import NetworkSettings
from sl3d_slam.lines.network.weights_file import model_hash, save_weights
from sl3d_slam.lines.scene import make_scene
from sl3d_slam.types import LineKind

POLE = np.array([7.0, 3.0])
CORNER = np.array([9.0, -5.0])
GROUND_M = -1.7


def sweep(rng, noise_m=0.01):
    """A street of a pole of 0.1 m radius and two walls that meet, about evenly sampled."""
    ground = np.c_[rng.uniform(-25, 25, (40_000, 2)), np.full(40_000, GROUND_M)]
    around = np.arctan2(-POLE[1], -POLE[0]) + rng.uniform(-1.4, 1.4, 900)
    pole = np.c_[POLE + 0.1 * np.c_[np.cos(around), np.sin(around)], rng.uniform(-1.7, 2.3, 900)]
    walls = []
    for direction in ((1.0, 0.0), (0.0, -1.0)):
        along = rng.uniform(0, 10, 9000)
        walls.append(np.c_[CORNER + along[:, None] * direction, rng.uniform(-1.7, 3.3, 9000)])
    points = np.vstack([ground, pole, *walls])
    return points + rng.normal(0, noise_m, points.shape)


def places(lines):
    return lines.endpoints.mean(axis=1)[:, :2]


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    torch.manual_seed(2)
    path = tmp_path_factory.mktemp("weights") / "untrained.safetensors"
    save_weights(path, SuperLine3D(NetworkSettings()), {})
    return path


@pytest.fixture(scope="module")
def extractor(weights):
    return LineExtractor(LineSettings(method="learned", weights=str(weights)))


@pytest.fixture(scope="module")
def lines(extractor):
    return extractor.extract(sweep(np.random.default_rng(4)))


def test_pole_and_corner_are_found_precisely(lines):
    for place, kind in ((POLE, LineKind.POLE), (CORNER, LineKind.VERTICAL_EDGE)):
        miss = np.linalg.norm(places(lines) - place, axis=1)
        assert miss.min() < 0.03  # noise of 1 cm, hundreds of returns
        assert lines.kinds[miss.argmin()] == kind


def test_lines_are_ranked_and_described(lines):
    assert (np.diff(lines.scores) <= 0).all()
    assert lines.scores.min() > 0
    assert lines.scores.max() <= 1
    np.testing.assert_allclose(np.linalg.norm(lines.descriptors, axis=1), 1.0, atol=1e-5)
    apart = np.linalg.norm(places(lines)[:, None] - places(lines)[None], axis=2)
    assert (apart + 9 * np.eye(len(lines))).min() > 0.2


def test_heading_of_the_sensor_does_not_matter(extractor, lines):
    T_turned_lidar = from_yaw(1.1, np.zeros(3))
    scan = sweep(np.random.default_rng(4))
    turned = extractor.extract(transform_points(T_turned_lidar, scan))
    moved = lines.transformed(T_turned_lidar)
    for place in (POLE, CORNER):
        place = T_turned_lidar[:2, :2] @ place
        first = np.linalg.norm(places(moved) - place, axis=1).argmin()
        second = np.linalg.norm(places(turned) - place, axis=1).argmin()
        assert np.linalg.norm(places(moved)[first] - places(turned)[second]) < 0.03
        # voxels and cells are cut along other directions; nothing else differs
        assert moved.descriptors[first] @ turned.descriptors[second] > 0.9


@pytest.mark.parametrize(
    "turn", [Rotation.from_euler("z", 2.0), Rotation.from_euler("xyz", [0.07, -0.05, -0.7])]
)
def test_shipped_weights_know_lines_whatever_the_heading_and_small_tilt(turn):
    extractor = LineExtractor.pretrained()
    scan = sweep(np.random.default_rng(4))
    lines = extractor.extract(scan)
    turned = extractor.extract(turn.apply(scan))
    back = turned.transformed(make_transform(turn.inv().as_matrix(), np.zeros(3)))
    for place in (POLE, CORNER):
        first = np.linalg.norm(places(lines) - place, axis=1).argmin()
        second = np.linalg.norm(places(back) - place, axis=1).argmin()
        assert np.linalg.norm(places(lines)[first] - places(back)[second]) < 0.04
        # on real streets the median is 0.95 and one in twenty falls below 0.83
        assert lines.descriptors[first] @ back.descriptors[second] > 0.8


def test_shipped_weights_say_where_lines_are():
    scan = sweep(np.random.default_rng(4))
    network = Network(extract.SHIPPED_WEIGHTS)
    points = network_points(make_scene(scan, LineSettings()), network.settings)
    probability = network.infer(points).probability
    beside = [np.linalg.norm(points[:, :2] - place, axis=1) for place in (POLE, CORNER)]
    assert probability[beside[0] < 0.25].mean() > 0.7
    assert probability[np.minimum(*beside) > 1.5].mean() < 0.3  # the walls' free ends included


def test_best_lines_are_kept(weights, lines):
    few = LineExtractor(LineSettings(method="learned", weights=str(weights), max_lines=2))
    kept = few.extract(sweep(np.random.default_rng(4)))
    np.testing.assert_array_equal(kept.endpoints, lines.endpoints[:2])


def test_empty_scans_give_no_lines(extractor):
    for scan in (np.full((100, 3), 5.0), np.full((100, 3), 500.0)):
        found = extractor.extract(scan)
        assert len(found) == 0
        assert found.descriptors.shape == (0, 64)


def test_model_names_the_weights(extractor, weights):
    assert extractor.model == f"superline3d-{model_hash(weights)}"
    assert LineExtractor(LineSettings(method="geometric")).model == "geometric"
    assert LineExtractor().model == LineExtractor.pretrained().model


def test_malformed_points_and_weights_are_refused(extractor, tmp_path):
    with pytest.raises(InputError, match="49 points"):
        extractor.extract(np.zeros((49, 3)))
    with pytest.raises(InputError, match=r"absent\.safetensors"):
        LineExtractor(LineSettings(method="learned", weights=str(tmp_path / "absent.safetensors")))


def test_unknown_device_is_refused(weights):
    with pytest.raises(InputError, match="device abacus"):
        LineExtractor(LineSettings(method="learned", weights=str(weights)), device="abacus")


def test_an_installation_without_weights_says_so(monkeypatch, tmp_path):
    monkeypatch.setattr(extract, "SHIPPED_WEIGHTS", tmp_path / "none.safetensors")
    with pytest.raises(MissingExtraError, match=r"lines\.method"):
        LineExtractor.pretrained()


def test_confident_points_alone_make_lines(rng):
    """Where the truth is told to it, growing finds the pole's axis and where the walls meet."""
    scene = make_scene(sweep(rng), LineSettings())
    points = np.c_[scene.points, scene.heights].astype(np.float32)
    near = [np.linalg.norm(points[:, :2] - place, axis=1) < 0.25 for place in (POLE, CORNER)]
    probability = np.where(near[0] | near[1], 0.9, 0.1).astype(np.float32)
    grown = grow_uprights(scene, points, probability, 0.8)
    assert len(grown) == 2
    for upright, kind in grown:
        place = POLE if kind == LineKind.POLE else CORNER
        miss = np.linalg.norm(upright.endpoints[:, :2] - place, axis=1)
        assert miss.max() < 0.04
        assert 2.5 < np.ptp(upright.endpoints[:, 2]) < 5.2
    assert {kind for _, kind in grown} == {LineKind.POLE, LineKind.VERTICAL_EDGE}
    assert grow_uprights(scene, points, np.zeros_like(probability), 0.8) == []
    everywhere = np.array([upright.endpoints.mean(axis=0)[:2] for upright, _ in grown])
    assert grow_uprights(scene, points, probability, 0.8, everywhere) == []
    apart = grow_uprights(scene, points, probability, 0.8, everywhere + 5.0)
    assert len(apart) == len(grown)


def test_points_along_a_leaning_line():
    segment = np.array([[[1.0, 0.0, 0.0], [2.0, 0.0, 4.0]]])
    points = np.float32(
        [[1.0, 0.3, 0, 0], [2.0, -0.3, 4, 0], [1.5, 0, 2, 0], [1.0, 0, 2, 0], [2.0, 0, 4.5, 0]]
    )
    # 0.35 m beside the line at its own height, and not beyond its ends
    assert points_along(segment, points)[0].tolist() == [0, 1, 2]

"""The compiled network against torch's, and what it needs to know of a file without torch."""

import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch

from sl3d_slam.lines.network.cells import find_cells
from sl3d_slam.lines.network.compiled import CompiledModel
from sl3d_slam.lines.network.inference import Network
from sl3d_slam.lines.network.model import SuperLine3D
from sl3d_slam.lines.network.neighbours import skip_neighbours
from sl3d_slam.lines.network.products import linear, packed
from sl3d_slam.lines.network.settings import NetworkSettings
from sl3d_slam.lines.network.shapes import expected_shapes
from sl3d_slam.lines.network.torch_model import TorchModel
from sl3d_slam.lines.network.weights_file import save_weights

FORMS = [
    {},
    {"width": 16, "descriptor_dim": 8, "num_neighbours": 7, "stride": 2},
    {"width": 70, "descriptor_dim": 66, "num_neighbours": 5},
    {"width": 5, "context": False, "heights": False},
    {"width": 16, "scale_invariant": True, "axes": "sensor", "num_neighbours": 2},
]


def model_of(changes):
    torch.manual_seed(5)
    return SuperLine3D(NetworkSettings(**changes)).eval()


def tensors_of(model):
    return {name: value.numpy() for name, value in model.state_dict().items()}


@pytest.fixture
def points(rng):
    """A wall, a pole and clutter around them: x, y, z and height."""
    wall = np.c_[rng.uniform(-12, 12, 700), np.full(700, 6.0), rng.uniform(0, 4, 700)]
    pole = np.c_[rng.normal([3.0, -2.0], 0.05, (60, 2)), rng.uniform(0, 4, 60)]
    cloud = np.vstack([wall, pole, rng.uniform([-30, -30, 0], [30, 30, 2], (471, 3))])
    return np.float32(np.c_[cloud, cloud[:, 2] + 0.3])


@pytest.mark.parametrize("changes", FORMS)
def test_compiled_and_torch_give_the_same(points, changes):
    model = model_of(changes)
    settings, tensors = model.settings, tensors_of(model)
    neighbours = skip_neighbours(points, settings.num_neighbours, settings.stride)
    rows = np.array([700, 3, 3, 1230, 0])
    answers = []
    for form in (CompiledModel(settings, tensors), TorchModel(settings, tensors, "cpu")):
        inference = form.infer(points, neighbours)
        answers.append((inference.probability, inference.describe(rows)))
    for compiled, literal in zip(*answers, strict=True):
        assert compiled.shape == literal.shape
        np.testing.assert_allclose(compiled, literal, rtol=0, atol=1e-5)  # float32's rounding


@pytest.mark.parametrize("changes", FORMS)
def test_expected_shapes_are_those_of_the_network(changes):
    model = model_of(changes)
    shapes = {name: tuple(value.shape) for name, value in model.state_dict().items()}
    assert expected_shapes(model.settings) == shapes


@pytest.mark.parametrize("count", [1, 3, 4, 7, 65])
@pytest.mark.parametrize("depth", [1, 2, 7])
def test_products_of_any_size(rng, count, depth):
    features = rng.normal(size=(count, depth + 3)).astype(np.float32)
    weight, bias = (rng.normal(size=s).astype(np.float32) for s in ((70, depth), 70))
    result = np.full((count, 128), np.nan, np.float32)
    linear(features, 2, packed(weight, bias), result)
    expected = features[:, 2 : 2 + depth] @ weight.T + bias
    np.testing.assert_allclose(result[:, :70], expected, atol=1e-5)
    assert not result[:, 70:].any()


def test_threads_beside_do_not_matter_to_the_bit(points):
    model = model_of({})
    form = CompiledModel(model.settings, tensors_of(model))
    neighbours = skip_neighbours(points, 20, 4)
    alone = form.infer(points, neighbours)
    with ThreadPoolExecutor(3) as pool:
        answers = list(pool.map(form.infer, [points] * 6, [neighbours] * 6))
    rows = np.arange(len(points))
    for inference in answers:
        np.testing.assert_array_equal(inference.probability, alone.probability)
        np.testing.assert_array_equal(inference.describe(rows), alone.describe(rows))


def test_cells_of_a_cloud_are_the_same_among_others(points):
    apart = points[:300, :3] + np.float32([2.0, 0.5, 0.0])
    both = find_cells(np.vstack([points[:, :3], apart]), np.repeat([0, 1], [len(points), 300]))
    alone = find_cells(apart, np.zeros(300, np.int64))
    before = both.cell_of[: len(points)].max() + 1
    np.testing.assert_array_equal(both.cell_of[len(points) :] - before, alone.cell_of)
    for joint, own, gaps, own_gaps in zip(
        both.neighbours, alone.neighbours, both.gaps, alone.gaps, strict=True
    ):
        np.testing.assert_array_equal(joint[before:] - before, own)
        np.testing.assert_array_equal(gaps[before:], own_gaps)
        assert joint[:before].max() < before


def test_nearest_cells_against_brute_force(points):
    cells = find_cells(points[:, :3], np.zeros(len(points), np.int64))
    count = len(cells.gaps[0])
    centres = np.array([points[cells.cell_of == k, :3].mean(axis=0) for k in range(count)])
    distance = np.linalg.norm(centres[:, None] - centres[None], axis=2)
    for stride, found in zip((1, 3), cells.neighbours, strict=True):
        expected = np.sort(distance, axis=1)[:, : 20 * stride : stride]
        near = np.take_along_axis(distance, found, axis=1)
        np.testing.assert_allclose(near, expected, atol=1e-4)  # means in float32
    assert np.ptp(points[cells.cell_of == 0, :3], axis=0).max() <= 2.0


def test_lines_are_learned_of_without_torch(tmp_path):
    """Torch takes two seconds and 200 MB to load, which a map needs not."""
    save_weights(tmp_path / "net", model_of({"width": 8}), {})
    code = (
        "import sys, numpy as np\n"
        "from sl3d_slam import LineExtractor\n"
        "from sl3d_slam.config import LineSettings\n"
        f"settings = LineSettings(method='learned', weights={str(tmp_path / 'net')!r})\n"
        "points = np.random.default_rng(0).uniform(-9.0, 9.0, (3000, 3))\n"
        "LineExtractor(settings).extract(points)\n"
        "assert 'torch' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_an_empty_cloud_has_no_lines(tmp_path):
    save_weights(tmp_path / "net", model_of({"width": 8, "descriptor_dim": 6}), {})
    inference = Network(tmp_path / "net").infer(np.zeros((0, 4), np.float32))
    assert inference.probability.shape == (0,)
    assert inference.describe(np.zeros(0, np.int64)).shape == (0, 6)

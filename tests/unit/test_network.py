"""The line network: what must not change its answers, and two forms of one layer."""

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from sl3d_slam.config import LineSettings
from sl3d_slam.lines.network.edgeconv import EdgeConv
from sl3d_slam.lines.network.feature_space import nearest_in_features
from sl3d_slam.lines.network.gather import gather_max
from sl3d_slam.lines.network.model import SuperLine3D
from sl3d_slam.lines.network.neighbours import skip_neighbours
from sl3d_slam.lines.network.offsets import edge_inputs
from sl3d_slam.lines.network.sample import network_points
from sl3d_slam.lines.network.settings import NetworkSettings
from sl3d_slam.lines.scene import make_scene

SMALL = NetworkSettings(width=16, descriptor_dim=8, num_neighbours=8, stride=2)


def make_model(settings=SMALL, seed=0):
    torch.manual_seed(seed)
    return SuperLine3D(settings).eval()


def run(model, points):
    settings = model.settings
    neighbours = skip_neighbours(points, settings.num_neighbours, settings.stride)
    with torch.no_grad():
        return model(torch.from_numpy(points), torch.from_numpy(neighbours))


@pytest.fixture
def cloud(rng):
    """A wall, a pole and clutter, rounded to 1/1024 m: shifts of whole metres are exact."""
    wall = np.c_[rng.uniform(-6, 6, 500), np.full(500, 5.0), rng.uniform(0, 4, 500)]
    pole = np.c_[rng.normal([3.0, -2.0], 0.05, (60, 2)), rng.uniform(0, 4, 60)]
    points = np.vstack([wall, pole, rng.uniform([-9, -9, 0], [9, 9, 2], (340, 3))])
    points += rng.normal(0, 0.02, points.shape)
    return np.float32(np.round(np.c_[points, points[:, 2] + 0.5] * 1024) / 1024)


def test_cheap_edgeconv_gives_the_same_numbers_and_gradients(rng):
    torch.manual_seed(3)
    layer = EdgeConv(7, 12)
    features = torch.randn(90, 7)
    neighbours = torch.from_numpy(rng.integers(0, 90, (90, 6)))
    results = []
    for form in (layer, layer.literal):
        layer.zero_grad()
        given = features.clone().requires_grad_()
        out = form(given, neighbours)
        (out * torch.linspace(-1, 1, 12)).square().sum().backward()
        gradients = [p.grad.clone() for p in layer.parameters()]
        results.append([out.detach(), given.grad, *gradients])
    for cheap, literal in zip(*results, strict=True):
        # float32 sums in another order
        torch.testing.assert_close(cheap, literal, rtol=1e-4, atol=1e-4)


def test_gather_max_is_indexing_and_maximum(rng):
    values = torch.randn(50, 5, requires_grad=True)
    neighbours = torch.from_numpy(rng.integers(0, 50, (70, 4)))
    weight = torch.randn(70, 5)
    largest = gather_max(values, neighbours)
    (fast,) = torch.autograd.grad((largest * weight).sum(), values)
    plain = values[neighbours].amax(dim=1)
    (slow,) = torch.autograd.grad((plain * weight).sum(), values)
    torch.testing.assert_close(largest, plain, rtol=0, atol=0)
    # a neighbour named twice shares the gradient in one and takes it whole in the other: same sum
    torch.testing.assert_close(fast, slow, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("stride", [1, 3, 4])
@pytest.mark.parametrize("kind", ["spread", "flat", "far outlier", "tiny"])
def test_skip_neighbours_against_brute_force(rng, stride, kind):
    points = rng.uniform(0, 20, (600, 3))
    match kind:
        case "flat":
            points[:, 2] = 1.0
        case "far outlier":
            points[7] = (9000.0, -4000.0, 3.0)
        case "tiny":
            points *= 0.005
    found = skip_neighbours(points, 10, stride)
    distance = np.linalg.norm(points[:, None] - points[None], axis=2)
    expected = np.sort(distance, axis=1)[:, : 10 * stride : stride]
    np.testing.assert_allclose(np.take_along_axis(distance, found, 1), expected, atol=1e-9)
    np.testing.assert_array_equal(found[:, 0], np.arange(600))


def test_few_points_are_spread_over_the_neighbours(rng):
    points = rng.uniform(0, 5, (13, 3))
    found = skip_neighbours(points, 20, 4)
    assert found.shape == (13, 20)
    nearest = cKDTree(points).query(points, 13)[1]
    # every one of the 13, none left out, in order of distance
    for row, order in zip(found, nearest, strict=True):
        np.testing.assert_array_equal(row[np.sort(np.unique(row, return_index=True)[1])], order)
    assert skip_neighbours(np.zeros((0, 3)), 20, 4).shape == (0, 20)
    assert skip_neighbours(np.ones((5, 3)), 4, 1).max() < 5


def test_moving_the_whole_cloud_changes_nothing(cloud):
    """No absolute position: the network cannot know where the sensor stands."""
    model = make_model()
    moved = cloud.copy()
    moved[:, :3] += np.float32([32.0, -16.0, 4.0])
    for here, there in zip(run(model, cloud), run(model, moved), strict=True):
        torch.testing.assert_close(here, there, rtol=0, atol=2e-5)


def test_heights_and_offsets_do_matter(cloud):
    model = make_model()
    raised = cloud.copy()
    raised[:, 3] += 3.0
    assert (run(model, cloud)[0] - run(model, raised)[0]).abs().max() > 1e-3
    squeezed = cloud * np.float32([0.5, 1, 1, 1])
    assert (run(model, cloud)[0] - run(model, squeezed)[0]).abs().max() > 1e-3


def test_order_of_points_does_not_matter(cloud, rng):
    model = make_model()
    order = rng.permutation(len(cloud))
    for straight, shuffled in zip(run(model, cloud), run(model, cloud[order]), strict=True):
        torch.testing.assert_close(straight[order], shuffled, rtol=0, atol=2e-5)


@pytest.mark.parametrize("yaw", [0.4, 2.0, -2.7])
def test_heading_does_not_matter(cloud, yaw):
    """Exact but for the cells of the wide view, which are cut along the sensor's axes."""
    model = make_model(SMALL.model_copy(update={"context": False}))
    turned = cloud.astype(np.float64)
    turned[:, :2] = turned[:, :2] @ np.array(
        [[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]]
    )
    here, there = run(model, cloud), run(model, turned.astype(np.float32))
    # rounding can turn the own axes of a neighbourhood without a direction, such as a lone point's
    same = (here[0] - there[0]).abs().amax(dim=1) < 1e-3
    assert same.float().mean() > 0.99
    in_sensor_axes = make_model(SMALL.model_copy(update={"axes": "sensor", "context": False}))
    apart = run(in_sensor_axes, cloud)[0] - run(in_sensor_axes, turned.astype(np.float32))[0]
    assert apart.abs().amax(dim=1).median() > 1e-3


@pytest.mark.parametrize("axes", ["sensor", "own"])
def test_scale_free_features_ignore_scale(cloud, axes):
    """Eq. 1 and 3 of the paper; scaling by a power of two is exact in floating point."""
    settings = SMALL.model_copy(update={"scale_invariant": True, "axes": axes, "context": False})
    neighbours = skip_neighbours(cloud, 8, 2)
    plain = edge_inputs(cloud, neighbours, settings)
    for scale in (0.125, 4.0):
        np.testing.assert_array_equal(
            edge_inputs(cloud * np.float32(scale), neighbours, settings), plain
        )
    np.testing.assert_allclose(
        edge_inputs(cloud * np.float32(0.3), neighbours, settings), plain, atol=1e-5
    )
    model = make_model(settings)
    for here, there in zip(run(model, cloud), run(model, cloud * np.float32(4.0)), strict=True):
        torch.testing.assert_close(here, there, rtol=0, atol=2e-5)


def test_scale_free_features_by_hand():
    points = np.float32([[0, 0, 0], [3, 4, 0], [0, 0, 5]])
    neighbours = np.array([[1, 2], [0, 0], [0, 0]])
    settings = SMALL.model_copy(update={"scale_invariant": True, "axes": "sensor"})
    first = edge_inputs(points, neighbours, settings)[0]
    # sum (p - q) = (-3, -4, -5), sum |p - q| = 10
    np.testing.assert_allclose(first[0], [-0.3, -0.4, -0.5, 0.0, 0.0, 0.5], atol=1e-6)
    np.testing.assert_allclose(first[1], [-0.3, -0.4, -0.5, 0.3, 0.4, 0.0], atol=1e-6)


@pytest.mark.parametrize("neighbours", ["space", "features"])
def test_clouds_in_one_pass_do_not_see_each_other(cloud, neighbours):
    model = make_model(SMALL.model_copy(update={"neighbours": neighbours}))
    second = cloud[:700] + np.float32([1.5, 0.25, 0.0, 0.5])
    found = [skip_neighbours(part, 8, 2) for part in (cloud, second)]
    joined = torch.from_numpy(np.vstack([cloud, second]))
    index = torch.from_numpy(np.vstack([found[0], found[1] + len(cloud)]))
    with torch.no_grad():
        together = model(joined, index, [len(cloud), len(second)])
    alone = [run(model, part) for part in (cloud, second)]
    for output in (0, 1):
        separate = torch.cat([alone[0][output], alone[1][output]])
        # float32: feature-space ties may fall either way in a few points
        close = (together[output] - separate).abs().amax(dim=1) < 1e-4
        assert close.float().mean() > (0.99 if neighbours == "features" else 0.999999)


def test_nearest_in_features_against_brute_force():
    features = torch.randn(60, 5)
    settings = SMALL.model_copy(update={"num_neighbours": 6, "stride": 3})
    found = nearest_in_features(features, settings, [40, 20])
    order = torch.cdist(features[:40], features[:40]).argsort(dim=1)[:, :18:3]
    assert (found[:40] == order).float().mean() > 0.99
    assert found[40:].min() >= 40


def test_outputs_are_logits_and_unit_descriptors(cloud):
    logits, descriptors = run(make_model(), cloud)
    assert logits.shape == (len(cloud), 2)
    torch.testing.assert_close(descriptors.norm(dim=1), torch.ones(len(cloud)))


@pytest.mark.parametrize("context", [True, False])
def test_every_weight_learns(cloud, context):
    model = make_model(SMALL.model_copy(update={"context": context})).train()
    neighbours = torch.from_numpy(skip_neighbours(cloud, 8, 2))
    logits, descriptors = model(torch.from_numpy(cloud), neighbours)
    (logits.square().sum() + (descriptors * torch.randn(8)).sum()).backward()
    for name, weight in model.named_parameters():
        assert weight.grad is not None, name
        assert weight.grad.abs().max() > 0, name


def test_network_points_are_voxel_means_above_ground(rng):
    ground = np.c_[rng.uniform(-30, 30, (30_000, 2)), rng.normal(-1.7, 0.01, 30_000)]
    pole = np.c_[rng.normal([8.0, 3.0], 0.03, (400, 2)), rng.uniform(-1.7, 2.3, 400)]
    scan = np.vstack([ground, pole])
    settings = NetworkSettings()
    points = network_points(make_scene(scan, LineSettings()), settings)
    assert points.dtype == np.float32
    assert np.abs(points[:, :2] - [8.0, 3.0]).max() < 0.15
    assert 4.0 / 0.25 - 2 <= len(points) < 4 * 4.0 / 0.25  # a voxel or, at its borders, up to four
    # the ground is at -1.7 and its height is known to a centimetre or two
    np.testing.assert_allclose(points[:, 3], points[:, 2] + 1.7, atol=0.05)
    again = make_scene(scan[rng.permutation(len(scan))], LineSettings())
    shuffled = network_points(again, settings)
    np.testing.assert_allclose(shuffled, points, atol=1e-4)
    near = network_points(again, settings, max_points=5)
    reach = np.linalg.norm(near[:, :3], axis=1)
    assert len(near) == 5
    assert reach.max() <= np.sort(np.linalg.norm(points[:, :3], axis=1))[4] + 1e-6


def test_a_scan_without_structure_is_an_empty_sample():
    nothing = make_scene(np.full((100, 3), 500.0), LineSettings())
    assert network_points(nothing, NetworkSettings()).shape == (0, 4)


@pytest.mark.parametrize("k", [1, 2, 3, 4, 5, 7, 8, 11])
def test_largest_over_any_number_of_neighbours(rng, k):
    values = torch.from_numpy(rng.normal(size=(30, 6)).astype(np.float32))
    neighbours = torch.from_numpy(rng.integers(0, 30, (50, k)))
    with torch.inference_mode():
        assert torch.equal(gather_max(values, neighbours), values[neighbours].amax(dim=1))

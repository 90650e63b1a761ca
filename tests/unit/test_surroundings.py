"""The layer over lines: what it hears, and that lines which look alike are then told apart."""

import os
import subprocess
import sys

import numpy as np
import pytest
import torch

from sl3d_slam.config import LineSettings
from sl3d_slam.errors import InputError
from sl3d_slam.geometry.se3 import from_yaw, invert, transform_points
from sl3d_slam.geometry.segments import transform_segments
from sl3d_slam.learning.joint_run import start_model
from sl3d_slam.learning.joint_settings import JointSettings
from sl3d_slam.learning.line_drives import LineDrive, LinePairs
from sl3d_slam.learning.surroundings import (
    SurroundingsSettings,
    learn_surroundings,
    with_surroundings,
    without_surroundings,
)
from sl3d_slam.lines.extract import LineExtractor
from sl3d_slam.lines.network.model import SuperLine3D
from sl3d_slam.lines.network.settings import NetworkSettings
from sl3d_slam.lines.network.surroundings import PRIOR, RINGS_M, heard_around, in_surroundings
from sl3d_slam.lines.network.weights_file import load_weights, model_hash, read_about, save_weights
from sl3d_slam.simulation.drive import plan_drive
from sl3d_slam.simulation.roads import Road
from sl3d_slam.simulation.town import build_town
from sl3d_slam.simulation.write import Layout, write_drive
from sl3d_slam.types import LineSet

SMALL = NetworkSettings(width=8, descriptor_dim=8, num_neighbours=6, stride=1)


def unit(rows):
    return (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)


@pytest.fixture
def some(rng):
    """Descriptors, places and scores of twelve lines."""
    return unit(rng.normal(size=(12, 8))), rng.uniform(-20, 20, (12, 2)), rng.uniform(0.1, 1, 12)


def model_of(settings=SMALL):
    torch.manual_seed(1)
    return SuperLine3D(settings)


def test_rings_hold_the_weighted_means_of_the_other_lines(some):
    descriptors, places, scores = some
    heard = heard_around(*some)
    assert heard.shape == (12, 8 * 6)
    np.testing.assert_array_equal(heard[:, :8], descriptors)
    for i in range(12):
        for ring, (radius, width) in enumerate(RINGS_M, 1):
            total, weight = np.zeros(8), PRIOR
            for j in range(12):
                if j != i:
                    off = np.hypot(*(places[i] - places[j])) - radius
                    share = scores[j] * np.exp(-0.5 * (off / width) ** 2)
                    total, weight = total + share * descriptors[j], weight + share
            np.testing.assert_allclose(heard[i, 8 * ring : 8 * ring + 8], total / weight, atol=1e-5)


def test_a_lone_line_hears_nothing(some):
    descriptors, places, scores = some
    assert not heard_around(descriptors[:1], places[:1], scores[:1])[:, 8:].any()
    assert heard_around(descriptors[:0], places[:0], scores[:0]).shape == (0, 48)


def test_neither_heading_nor_place_nor_order_matters(some, rng):
    descriptors, places, scores = some
    heard = heard_around(*some)
    T = from_yaw(2.1, np.array([30.0, -7.0, 0.0]))
    moved = transform_points(T, np.c_[places, np.zeros(12)])[:, :2]
    np.testing.assert_allclose(heard_around(descriptors, moved, scores), heard, atol=1e-5)
    order = rng.permutation(12)
    shuffled = heard_around(descriptors[order], places[order], scores[order])
    np.testing.assert_allclose(shuffled, heard[order], atol=1e-5)


def test_reading_gives_what_the_layer_of_torch_gives(some):
    layer = with_surroundings(model_of()).surroundings
    tensors = {f"surroundings.{name}": value.numpy() for name, value in layer.state_dict().items()}
    with torch.no_grad():
        literal = torch.nn.functional.normalize(layer(torch.from_numpy(heard_around(*some))), dim=1)
    np.testing.assert_allclose(in_surroundings(*some, tensors), literal.numpy(), atol=1e-5)


def test_models_without_the_layer_keep_their_names_and_others_get_their_own(tmp_path):
    model = model_of()
    # of the same weights before there was such a layer
    assert model_hash(model) == "e2a8c82b"
    grown = with_surroundings(model)
    assert model_hash(grown) != model_hash(model)
    assert model_hash(without_surroundings(grown)) == model_hash(model)
    save_weights(tmp_path / "grown.safetensors", grown, {})
    assert model_hash(load_weights(tmp_path / "grown.safetensors")) == model_hash(grown)
    # more joint training changes what the layer hears: it is taught anew after that
    start = start_model(SMALL, JointSettings(), tmp_path / "grown.safetensors")
    assert start.surroundings is None


@pytest.fixture(scope="module")
def street():
    """Forty lines of five looks along a street, seen from nine places six metres apart."""
    rng = np.random.default_rng(3)
    places = np.c_[np.sort(rng.uniform(-10, 60, 40)), rng.choice([-6.0, 6.0], 40)]
    places += rng.uniform(-1, 1, (40, 2))
    ends = np.stack([np.c_[places, np.full(40, h)] for h in (-1.5, 2.0)], axis=1)
    looks = unit(rng.normal(size=(5, 8)))[rng.integers(0, 5, 40)]
    poses = np.array([from_yaw(0.3 * k, np.array([6.0 * k, 0, 0])) for k in range(9)])
    scans = []
    for T in poses:
        rows = rng.permutation(40)[:34]
        scans.append(
            LineSet(
                transform_segments(invert(T), ends[rows]),
                unit(looks[rows] + 0.1 * rng.normal(size=(34, 8))),
                np.full(34, 9),
                np.ones(34, np.uint8),
                np.full(34, 0.5, np.float32),
            )
        )
    return LineDrive("street", True, poses, tuple(scans))


def share_first(drive, known):
    """Share of lines whose partner ranks first among the lines of the other scan."""
    pairs, rng, right = LinePairs(drive, 0.3, 30.0), np.random.default_rng(0), []
    for _ in range(20):
        pair = pairs.draw(rng)
        assert len(pair.matches) >= 20
        first, second = known(pair.first), known(pair.second)
        scores = first[pair.matches[:, 0]] @ second.T
        right.append(np.mean(scores.argmax(axis=1) == pair.matches[:, 1]))
    return np.mean(right)


def test_lines_that_look_alike_are_told_apart_by_what_is_around_them(street):
    model = model_of()
    settings = SurroundingsSettings(steps=150, descriptor_noise=0.1)
    taught = learn_surroundings(model, [street], settings)
    tensors = {f"surroundings.{k}": v.numpy() for k, v in taught.surroundings.state_dict().items()}

    def known(lines):
        places = lines.endpoints.mean(axis=1)[:, :2]
        return in_surroundings(lines.descriptors, places, lines.scores, tensors)

    before = share_first(street, lambda lines: lines.descriptors)
    after = share_first(street, known)
    assert before < 0.2  # five looks of about seven lines each
    assert after > 0.5
    for name, value in model.state_dict().items():
        assert torch.equal(taught.state_dict()[name], value)
    again = learn_surroundings(model, [street], settings)
    assert model_hash(again) == model_hash(taught)


def test_drives_without_pairs_are_refused(street):
    poses = street.T_world_lidar.copy()
    poses[:, 0, 3] *= 100.0
    apart = LineDrive("apart", True, poses, street.lines)
    with pytest.raises(InputError, match="no two scans of one drive lie within 30 m"):
        learn_surroundings(model_of(), [apart], SurroundingsSettings(steps=1))


def test_the_verb_leaves_weights_that_extraction_uses(sl3d, tmp_path):
    way = 4.0 * np.arange(6)
    bend = np.column_stack([way, 0.004 * way**2, np.zeros(6), np.arctan(0.008 * way)])
    planned = plan_drive(build_town(Road("bend", bend), 63), "hdl32")
    town = write_drive(planned, Layout(tmp_path / "town", "63"))
    bare, out = tmp_path / "bare.safetensors", tmp_path / "taught.safetensors"
    save_weights(bare, model_of(), {"step": "7"})
    result = sl3d("train", "surroundings", bare, town, "--out", out, "--steps", "20")
    assert result.returncode == 0, result.stderr
    assert read_about(out)["about.step"] == "7"
    assert "20 steps, seed 0, on 63" in read_about(out)["about.surroundings"]
    scan = np.fromfile(sorted(town.glob("velodyne/*.bin"))[0], np.float32).reshape(-1, 4)[:, :3]
    plain, taught = (
        LineExtractor(LineSettings(weights=str(file))).extract(scan) for file in (bare, out)
    )
    np.testing.assert_array_equal(plain.endpoints, taught.endpoints)
    np.testing.assert_allclose(np.linalg.norm(taught.descriptors, axis=1), 1.0, atol=1e-5)
    # the sensor stands nearly level, so that places in its frame are those of the level one
    layer = load_weights(out).state_dict()
    tensors = {name: value.numpy() for name, value in layer.items() if "surroundings" in name}
    places = plain.endpoints.mean(axis=1)[:, :2]
    expected = in_surroundings(plain.descriptors, places, plain.scores, tensors)
    assert (expected * taught.descriptors).sum(axis=1).min() > 0.99
    again = sl3d("train", "surroundings", out, town, "--out", out)
    assert again.returncode != 0
    assert "went through sl3d train surroundings before" in again.stderr


def test_descriptors_are_the_same_to_the_bit_whatever_the_number_of_blas_threads():
    program = """
import sys
import numpy as np
from sl3d_slam.lines.network.surroundings import in_surroundings
rng = np.random.default_rng(3)
descriptors, tensors = rng.standard_normal((150, 64)).astype(np.float32), {
    "surroundings.weight": rng.standard_normal((64, 384)).astype(np.float32),
    "surroundings.bias": np.zeros(64, np.float32),
}
places, scores = rng.uniform(-40, 40, (150, 2)), rng.uniform(0, 1, 150)
sys.stdout.buffer.write(in_surroundings(descriptors, places, scores, tensors).tobytes())
"""
    one, two = (
        subprocess.run(
            [sys.executable, "-c", program],
            env=os.environ | {"OPENBLAS_NUM_THREADS": threads},
            stdout=subprocess.PIPE,
            check=True,
        ).stdout
        for threads in "12"
    )
    assert len(one) == 150 * 64 * 4
    assert one == two

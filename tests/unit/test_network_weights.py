"""Weights on disk: what was saved comes back, anything else is refused in a sentence."""

import json

import pytest
import torch
from safetensors.torch import save as dump_tensors

from sl3d_slam.errors import InputError
from sl3d_slam.lines.network.model import SuperLine3D
from sl3d_slam.lines.network.settings import NetworkSettings
from sl3d_slam.lines.network.weights_file import (
    FORMAT,
    load_weights,
    model_hash,
    read_about,
    save_weights,
)

SETTINGS = NetworkSettings(width=8, descriptor_dim=4, stride=2)


@pytest.fixture
def model():
    torch.manual_seed(0)
    return SuperLine3D(SETTINGS)


@pytest.fixture
def path(model, tmp_path):
    file = tmp_path / "net.safetensors"
    save_weights(file, model, {"seed": "7"})
    return file


def test_weights_come_back_bit_for_bit(model, path):
    again = load_weights(path)
    assert again.settings == SETTINGS
    assert not again.training
    for name, value in model.state_dict().items():
        torch.testing.assert_close(again.state_dict()[name], value, rtol=0, atol=0)
    assert read_about(path)["about.seed"] == "7"
    save_weights(path, again, {"seed": "7"})
    assert model_hash(path) == model_hash(model)


def test_hash_follows_weights_and_settings(model):
    before = model_hash(model)
    assert len(before) == 8
    with torch.no_grad():
        next(model.parameters())[0, 0] += 1e-3
    assert model_hash(model) != before
    torch.manual_seed(0)
    assert model_hash(SuperLine3D(SETTINGS.model_copy(update={"stride": 3}))) != before


def test_default_network_fits_the_wheel(tmp_path):
    model = SuperLine3D(NetworkSettings())
    assert sum(weight.numel() for weight in model.parameters()) < 500_000
    save_weights(tmp_path / "net", model, {})
    assert (tmp_path / "net").stat().st_size < 2_000_000


def test_any_cut_file_is_refused(path):
    raw = path.read_bytes()
    for length in [0, 1, 7, 8, 9, 100, 500, len(raw) // 2, len(raw) - 1]:
        path.write_bytes(raw[:length])
        with pytest.raises(InputError, match=r"net\.safetensors: .*expected weights"):
            load_weights(path)


def test_damaged_bytes_are_refused_or_harmless(path, rng):
    raw, refusals = path.read_bytes(), []
    for place in rng.integers(0, 1500, 25):
        damaged = bytearray(raw)
        damaged[place] ^= 0xFF
        path.write_bytes(bytes(damaged))
        try:
            load_weights(path)
        except InputError as error:
            refusals.append(str(error))
    assert len(refusals) > 10  # most of the first bytes are the header
    assert all("net.safetensors" in refusal for refusal in refusals)


def _file(path, tensors, **metadata):
    path.write_bytes(dump_tensors(tensors, metadata=metadata))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda t: t.pop("blocks.1.norm.weight"), "blocks.1.norm.weight is missing"),
        (lambda t: t.update(extra=torch.zeros(3)), "extra is unknown"),
        (lambda t: t.update({"blocks.1.norm.weight": torch.zeros(9)}), r"\(9,\), not \(8,\)"),
        (lambda t: t.update({"blocks.1.norm.weight": torch.zeros(8).half()}), "float16"),
        (lambda t: t["blocks.1.norm.weight"].fill_(float("nan")), "NaN or infinity"),
    ],
)
def test_wrong_tensors_are_named(model, tmp_path, change, words):
    tensors = {name: value.clone() for name, value in model.state_dict().items()}
    change(tensors)
    _file(tmp_path / "net", tensors, format=FORMAT, settings=SETTINGS.model_dump_json())
    with pytest.raises(InputError, match=words):
        load_weights(tmp_path / "net")


@pytest.mark.parametrize(
    ("metadata", "words"),
    [
        ({}, "not a line network"),
        ({"format": "another 1", "settings": SETTINGS.model_dump_json()}, "not a line network"),
        ({"format": FORMAT}, "settings"),
        ({"format": FORMAT, "settings": "{"}, "settings"),
        ({"format": FORMAT, "settings": json.dumps({"width": 100_000})}, "width"),
        ({"format": FORMAT, "settings": json.dumps({"depth": 3})}, "depth"),
    ],
)
def test_foreign_headers_are_refused(model, tmp_path, metadata, words):
    _file(tmp_path / "net", dict(model.state_dict()), **metadata)
    with pytest.raises(InputError, match=words):
        load_weights(tmp_path / "net")


def test_missing_large_or_other_files_are_refused(tmp_path):
    with pytest.raises(InputError, match="No such file"):
        load_weights(tmp_path / "absent")
    with pytest.raises(InputError, match="directory"):
        load_weights(tmp_path)
    (tmp_path / "large").write_bytes(b"\0" * 2_000_001)
    with pytest.raises(InputError, match="larger than 2000000 bytes"):
        load_weights(tmp_path / "large")
    torch.save({"weight": torch.zeros(3)}, tmp_path / "pickle")
    with pytest.raises(InputError, match="not a line network"):
        load_weights(tmp_path / "pickle")

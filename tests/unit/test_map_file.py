import json
import os
import struct
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from safetensors import safe_open
from safetensors.numpy import save

from sl3d_slam.config import MapSettings
from sl3d_slam.errors import InputError, OutputError
from sl3d_slam.geometry.se3 import exp, invert
from sl3d_slam.geometry.segments import midpoints
from sl3d_slam.mapping.file import KEY, checksum
from sl3d_slam.mapping.line_map import LineMap, MapOrigin
from sl3d_slam.mapping.quantise import quantise, restore
from sl3d_slam.mapping.tensors import map_tensors
from sl3d_slam.mapping.varint import pack, pack_table
from sl3d_slam.types import LineKind, LineSet

ORIGIN = MapOrigin("geometric 0123", "seed: 0\n", simulated=True)


def make_map(rng, clouds=True, count=40):
    truth = np.repeat(rng.uniform([0, -20, -1], [80, 20, 0], (count, 1, 3)), 2, axis=1)
    truth[:, 1, 2] += rng.uniform(1, 5, count)
    descriptors = rng.normal(0, 1, (count, 28)).astype(np.float32)
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    kinds = rng.integers(0, len(LineKind), count).astype(np.uint8)
    poses = np.array(
        [exp(np.array([0.02, -0.1, 0.5 + 0.1 * k, 5.0 * k, 1.0, 2.0])) for k in range(12)]
    )
    poses = exp(np.array([0.0, 0.0, 0.3, 400.0, -2000.0, 7.0])) @ poses
    world = truth @ poses[0, :3, :3].T + poses[0, :3, 3]
    seen = []
    for T in poses:
        chosen = rng.random(count) < 0.6
        lines = LineSet(
            world[chosen], descriptors[chosen], rng.integers(5, 90, chosen.sum()), kinds[chosen],
            rng.random(chosen.sum()).astype(np.float32),
        )  # fmt: skip
        seen.append(lines.transformed(invert(T)))
    up = rng.normal([0, 0, 1], 0.05, (12, 3))
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    points = [rng.uniform(-20, 20, (300, 3)).astype(np.float32) for _ in poses] if clouds else None
    settings = MapSettings(min_seen_share=0.0, cloud_min_keyframes=1)
    return LineMap.build(seen, poses, up, points, settings, ORIGIN)


@pytest.fixture(scope="module")
def line_map():
    return make_map(np.random.default_rng(5))


def write_forged(path, tensors, **changes):
    """Write a file with a fitting checksum, whatever it holds."""
    header = {
        "format": "sl3d line map", "version": 2, "model": "m", "config": "", "simulated": False,
        "cloud_voxel_m": 0.8,
    } | changes  # fmt: skip
    header["checksum"] = checksum(header, tensors)
    path.write_bytes(save(tensors, {KEY: json.dumps(header)}))
    return path


@pytest.mark.parametrize("clouds", [True, False])
def test_what_is_written_is_read_within_the_steps_of_the_file(tmp_path, rng, clouds):
    written = make_map(rng, clouds)
    written.save(tmp_path / "map.sl3d")
    read = LineMap.load(tmp_path / "map.sl3d")
    half_mm = 0.5e-3 + 1e-9
    assert np.abs(read.lines.endpoints[:, 0] - written.lines.endpoints[:, 0]).max() <= half_mm
    assert np.abs(read.lines.endpoints[:, 1] - written.lines.endpoints[:, 1]).max() <= half_mm
    shift = read.T_map_keyframe - written.T_map_keyframe
    assert np.abs(shift[:, :3, 3]).max() <= half_mm
    assert np.abs(shift[:, :3, :3]).max() <= 1e-5  # half a step of 1e-5 rad on each axis
    assert np.abs(read.keyframe_up - written.keyframe_up).max() <= 1e-4
    # a step is a seventh of a dimension's largest entry; measured loss at 28 dimensions is 0.006
    assert (read.lines.descriptors * written.lines.descriptors).sum(axis=1).min() > 0.99
    assert np.abs(read.lines.scores - written.lines.scores).max() <= 0.5 / 255 + 1e-6
    for name in ("kinds", "num_points"):
        assert np.array_equal(getattr(read.lines, name), getattr(written.lines, name))
    for name in ("offsets", "indices", "support"):
        assert np.array_equal(getattr(read, name), getattr(written, name))
    assert read.origin == ORIGIN
    assert (read.cloud is None) == (written.cloud is None) == (not clouds)
    if written.cloud is not None:
        assert np.array_equal(read.cloud.all_points(), written.cloud.all_points())
        assert read.cloud.voxel_m == 0.8


def test_a_second_writing_changes_nothing_but_rounding(tmp_path, line_map):
    line_map.save(tmp_path / "a")
    once = LineMap.load(tmp_path / "a")
    assert once.to_bytes() == once.to_bytes()
    assert line_map.to_bytes() == (tmp_path / "a").read_bytes()
    once.save(tmp_path / "b")
    twice = LineMap.load(tmp_path / "b")
    assert np.array_equal(once.lines.endpoints, twice.lines.endpoints)
    assert np.allclose(once.T_map_keyframe, twice.T_map_keyframe, atol=1e-9)


def test_header_tells_what_the_file_is(tmp_path, line_map):
    line_map.save(tmp_path / "map.sl3d")
    with safe_open(tmp_path / "map.sl3d", framework="numpy") as file:  # as a stranger would
        header = json.loads(file.metadata()[KEY])
        shapes = {name: file.get_tensor(name).dtype.name for name in file.keys()}  # noqa: SIM118
    assert header["format"] == "sl3d line map"
    assert header["version"] == 2
    assert header["model"] == "geometric 0123"
    assert header["simulated"] is True
    assert header["landmarks"] == len(line_map)
    assert header["keyframes"] == 12
    assert header["cloud_voxel_m"] == 0.8
    assert "keyframe coordinates to map coordinates" in header["frames"]
    assert set(shapes) - set(header["coding"]) == {"kinds", "descriptor_scales"}
    assert shapes == {
        "endpoints": "uint8", "num_points": "uint8", "kinds": "uint8", "scores": "uint8",
        "descriptors": "uint8", "descriptor_scales": "float32", "poses": "uint8", "up": "uint8",
        "support": "uint8", "seen_by": "uint8", "cloud_blocks": "uint8", "cloud_keys": "uint8",
        "cloud_means": "uint16",
    }  # fmt: skip


def test_an_older_file_stays_readable(tmp_path):
    """Tensors written out by hand, as version 1 codes them."""
    tensors = {
        "endpoints": np.array([0xD0, 0x0F, 0, 0, 0, 0, 0xD0, 0x0F], np.uint8),  # 1,0,0 -> 1,0,1 m
        "num_points": np.array([14], np.uint8),
        "kinds": np.array([1], np.uint8),
        "scores": np.array([255], np.uint8),
        # entries 62 (=31) and 31 (=0): 011111 111110, low bit of each first
        "descriptors": np.array([[0b01111111, 0b11100000]], np.uint8),
        "descriptor_scales": np.array([0.5, 0.5], np.float32),
        "poses": np.array([0xA0, 0x1F, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0], np.uint8),  # x 2 m, twice
        "up": np.array([0, 0, 0xA0, 0x9C, 1, 0, 0, 0], np.uint8),
        "support": np.array([2], np.uint8),
        "seen_by": np.array([0, 0], np.uint8),
    }
    read = LineMap.load(write_forged(tmp_path / "old", tensors, cloud_voxel_m=None, version=1))
    assert read.lines.endpoints.tolist() == [[[1, 0, 0], [1, 0, 1]]]
    assert read.lines.num_points.tolist() == [7]
    assert read.lines.kinds.tolist() == [LineKind.POLE]
    assert read.lines.descriptors.tolist() == [[1.0, 0.0]]
    assert read.T_map_keyframe[:, 0, 3].tolist() == [2.0, 2.0]
    assert read.keyframe_up.tolist() == [[0, 0, 1], [0, 0, 1]]
    assert (read.offsets.tolist(), read.indices.tolist()) == ([0, 1, 2], [0, 0])


def test_missing_empty_foreign_and_folder_are_named(tmp_path, line_map):
    (tmp_path / "empty").write_bytes(b"")
    (tmp_path / "text").write_text("x y z\n1 2 3\n" * 100)
    (tmp_path / "weights").write_bytes(save({"layer": np.zeros(3, np.float32)}))
    (tmp_path / "other").write_bytes(save({"a": np.zeros(3)}, {"format": "pt"}))
    (tmp_path / "list").write_bytes(save({"a": np.zeros(3)}, {KEY: "[1, 2]"}))
    (tmp_path / "deep").write_bytes(save({"a": np.zeros(3)}, {KEY: "[" * 100_000}))
    (tmp_path / "folder").mkdir()
    for name in ("missing", "empty", "text", "weights", "other", "list", "deep", "folder"):
        with pytest.raises(InputError, match=rf"{name}: .*expected a line map") as caught:
            LineMap.load(tmp_path / name)
        assert "\n" not in str(caught.value)


def test_newer_version_is_refused_before_anything_else(tmp_path):
    path = tmp_path / "next.sl3d"
    path.write_bytes(
        save({"what": np.zeros(2)}, {KEY: json.dumps({"format": "sl3d line map", "version": 3})})
    )
    with pytest.raises(InputError, match=r"next\.sl3d: .*version 3, newer .* 2; expected"):
        LineMap.load(path)


def test_every_truncation_is_an_error(tmp_path, rng):
    content = make_map(rng, clouds=False, count=3).to_bytes()
    path = tmp_path / "cut.sl3d"
    for size in [*range(0, 64), *range(64, len(content), 97), len(content) - 1]:
        path.write_bytes(content[:size])
        with pytest.raises(InputError, match=r"cut\.sl3d"):
            LineMap.load(path)
    path.write_bytes(content + b"\0")
    with pytest.raises(InputError, match=r"cut\.sl3d"):
        LineMap.load(path)


def test_every_flipped_bit_is_found(tmp_path, rng):
    content = make_map(rng, clouds=True, count=3).to_bytes()
    path = tmp_path / "flip.sl3d"
    header_bytes = 8 + struct.unpack("<Q", content[:8])[0]
    places = [*range(0, header_bytes, 7), *rng.integers(header_bytes, len(content), 300)]
    for place in places:
        flipped = bytearray(content)
        flipped[place] ^= 1 << int(rng.integers(8))
        path.write_bytes(flipped)
        with pytest.raises(InputError, match=r"flip\.sl3d"):
            LineMap.load(path)


FORGERIES = {
    "endpoints": [
        pack_table(np.zeros((2, 6), np.int64)),  # rows missing
        pack_table(np.full((40, 6), 2**40)),  # off the planet
        np.full(5000, 0x80, np.uint8),  # an integer without end
        np.zeros(0, np.uint8),
        np.zeros((40, 6), np.float64),
        np.full((40, 6), np.nan, np.float32),
    ],
    "num_points": [pack_table(np.full((40, 1), -1))],
    "kinds": [np.full(40, 9, np.uint8), np.zeros(39, np.uint8), np.zeros((40, 1), np.uint8)],
    "scores": [np.zeros(41, np.uint8)],
    "descriptors": [np.zeros((40, 20), np.uint8), np.zeros((39, 21), np.uint8)],
    "descriptor_scales": [
        np.full(28, value, np.float32) for value in (np.nan, np.inf, 0.0, -1.0)
    ] + [np.ones(24, np.float32), np.ones((28, 1), np.float32)],
    "poses": [
        pack_table(np.zeros((11, 6), np.int64)),
        pack_table(np.full((12, 6), 2**39)),
        np.zeros(7, np.uint8),
    ],
    "up": [pack_table(np.zeros((12, 3), np.int64)), pack_table(np.full((3, 3), 5773))],
    "support": [
        pack(np.zeros(40, np.int64)),
        pack(np.full(40, 2**41)),
        pack(np.ones(39, np.int64)),
    ],
    "seen_by": [np.zeros(0, np.uint8), np.zeros(3, np.uint8)],
    "cloud_blocks": [
        pack_table(np.full((2, 5), -3)),
        pack_table(np.array([[0, 0, 0, 2**39, 2**39]])),
        np.zeros(0, np.uint8),
        np.zeros(3, np.uint8),
    ],
    "cloud_keys": [np.zeros(1, np.uint8)],
    "cloud_means": [np.zeros(1, np.uint16), np.zeros(5, np.int32)],
}  # fmt: skip
CASES = [(name, k) for name, forged in FORGERIES.items() for k in range(len(forged))]


@pytest.mark.parametrize(("name", "k"), CASES)
def test_unsound_arrays_are_refused_though_the_checksum_fits(tmp_path, line_map, name, k):
    tensors = map_tensors(line_map)
    assert len(line_map) == 40
    LineMap.load(write_forged(tmp_path / "sound", tensors))
    path = write_forged(tmp_path / "forged.sl3d", tensors | {name: FORGERIES[name][k]})
    with pytest.raises(InputError, match=r"forged\.sl3d: is not a sound line map; .+"):
        LineMap.load(path)


def test_sightings_by_keyframes_that_do_not_exist_are_refused(tmp_path, line_map):
    tensors = map_tensors(line_map)
    seen_by = np.zeros(int(line_map.support.sum()), np.int64)
    seen_by[-1] = 12
    path = write_forged(tmp_path / "forged.sl3d", tensors | {"seen_by": pack(seen_by)})
    with pytest.raises(InputError, match=r"forged\.sl3d: .*keyframes below 12"):
        LineMap.load(path)


def test_missing_extra_and_exotic_arrays_are_refused(tmp_path, line_map):
    tensors = map_tensors(line_map)
    for changed in (
        {name: tensor for name, tensor in tensors.items() if name != "poses"},
        tensors | {"more": np.zeros(1)},
        {name: tensor for name, tensor in tensors.items() if not name.startswith("cloud")},
    ):
        with pytest.raises(InputError, match=r"forged: .*expected the arrays"):
            LineMap.load(write_forged(tmp_path / "forged", changed))
    content = (tmp_path / "forged").read_bytes().replace(b'"U8"', b'"I8"', 1)
    (tmp_path / "exotic").write_bytes(content)
    with pytest.raises(InputError, match="exotic"):
        LineMap.load(tmp_path / "exotic")
    (tmp_path / "bf16").write_bytes(content.replace(b'"U16"', b'"BF16"'))
    with pytest.raises(InputError, match="bf16"):
        LineMap.load(tmp_path / "bf16")


@pytest.mark.parametrize(
    "change",
    [{"cloud_voxel_m": value} for value in (0, -1, 1e9, "a", [1])]
    + [{"model": 3}, {"config": None}, {"simulated": "yes"}],
)
def test_unsound_header_is_refused(tmp_path, line_map, change):
    path = write_forged(tmp_path / "forged", map_tensors(line_map), **change)
    with pytest.raises(InputError, match="forged: is not a sound line map; expected"):
        LineMap.load(path)


def test_a_claim_of_terabytes_allocates_nothing(tmp_path):
    claims = [struct.pack("<Q", 2**62) + b"{}"]
    for shape in ([2**40], [2**31, 2**31], [2**63]):
        table = {"endpoints": {"dtype": "U8", "shape": shape, "data_offsets": [0, 2**40]}}
        text = json.dumps(table).encode()
        claims.append(struct.pack("<Q", len(text)) + text + b"\0" * 16)
    path = tmp_path / "huge.sl3d"
    for claim in claims:
        path.write_bytes(claim)
        tracemalloc.start()
        with pytest.raises(InputError, match=r"huge\.sl3d"):
            LineMap.load(path)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 2e6


def test_failed_saving_leaves_the_old_map(tmp_path, line_map, monkeypatch):
    path = tmp_path / "map.sl3d"
    path.write_bytes(b"old")

    def full(*_args):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OutputError, match=r"map\.sl3d: .*disk is full"):
        line_map.save(path)
    assert path.read_bytes() == b"old"
    assert len(list(tmp_path.iterdir())) == 1


def test_a_map_of_nothing_is_a_map(tmp_path):
    none = LineMap.build([], np.zeros((0, 4, 4)), np.zeros((0, 3)), None, MapSettings())
    none.save(tmp_path / "none.sl3d")
    read = LineMap.load(tmp_path / "none.sl3d")
    assert (len(read), len(read.T_map_keyframe), read.offsets.tolist()) == (0, 0, [0])


@pytest.mark.parametrize("dimension", [0, 1, 28, 64])
def test_descriptors_keep_their_angles(rng, dimension):
    unit = rng.normal(0, 1, (5000, dimension)).astype(np.float32)
    unit /= np.maximum(np.linalg.norm(unit, axis=1, keepdims=True), 1e-9)
    packed, scales = quantise(unit)
    assert packed.shape == (5000, -(-4 * dimension // 8))
    restored = restore(packed, scales)
    assert restored.dtype == np.float32
    if dimension:
        # the largest of 5,000 entries is 3.9 of their sigma: rounding by a 14th of that, 0.16 sigma
        assert (restored * unit).sum(axis=1).mean() > 0.985
        assert (restored * unit).sum(axis=1).min() > 0.96


def test_what_no_file_can_hold_is_refused(tmp_path, line_map):
    for value in (np.nan, np.inf, 1e12):
        moved = line_map.transformed(np.eye(4))
        moved.T_map_keyframe[3, 0, 3] = value
        with pytest.raises(OutputError, match=r"map\.sl3d: .*finite and below"):
            moved.save(tmp_path / "map.sl3d")
    unseen = replace(line_map, indices=np.zeros_like(line_map.indices))
    with pytest.raises(OutputError, match="a keyframe that saw it"):
        unseen.save(tmp_path / "map.sl3d")
    assert list(tmp_path.iterdir()) == []


def test_size_of_a_kilometre(rng):
    """1,000 landmarks of 64 dimensions, seen nine times each from 330 keyframes on a kilometre."""
    count, keyframes = 1000, 330
    x = np.sort(rng.uniform(0, 1000, count))
    foot = np.c_[x, rng.uniform(-25, 25, count), rng.uniform(-2, 0, count)]
    endpoints = np.stack(
        [foot, foot + np.c_[rng.normal(0, 0.1, (count, 2)), rng.uniform(1, 6, count)]], axis=1
    )
    unit = rng.normal(0, 1, (count, 64)).astype(np.float32)
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    lines = LineSet(endpoints, unit, rng.integers(10, 200, count))
    poses = np.array([exp(np.r_[rng.normal(0, 0.02, 3), 3.03 * k, 0, 0]) for k in range(keyframes)])
    nearest = np.clip((x / 3.03).astype(int), 5, keyframes - 6)
    seen = np.sort(
        nearest[:, None] + rng.permuted(np.tile(np.arange(-5, 6), (count, 1)), axis=1)[:, :9]
    )
    rows = np.stack([seen.ravel(), np.repeat(np.arange(count), 9)], axis=1)
    rows = rows[np.lexsort(rows.T[::-1])]
    offsets = np.searchsorted(rows[:, 0], np.arange(keyframes + 1)).astype(np.int64)
    up = np.tile([0.0, 0.0, 1.0], (keyframes, 1))
    built = LineMap(lines, poses, up, offsets, rows[:, 1].astype(np.int64))
    assert len(built.to_bytes()) < 100_000  # the target for a kilometre of street, lines alone
    assert midpoints(built.lines.endpoints).shape == (count, 3)

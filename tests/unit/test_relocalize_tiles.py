"""Maps laid out side by side: as many lines as asked, the asked-for towns unchanged, no twins."""

import numpy as np
import pytest

from sl3d_slam.bench.relocalize import figures
from sl3d_slam.bench.relocalize_reliability import reliability
from sl3d_slam.bench.relocalize_tiles import lay_out
from sl3d_slam.config import MapSettings
from sl3d_slam.geometry.se3 import from_yaw, invert, transform_points
from sl3d_slam.mapping.line_map import LineMap, MapOrigin
from sl3d_slam.types import LineSet


@pytest.fixture(scope="module")
def town():
    rng = np.random.default_rng(2)
    places = rng.uniform(-40, 40, (60, 2))
    poses = np.array([from_yaw(0.3 * k, np.array([6.0 * k - 24, 3.0, 1.7])) for k in range(8)])
    ends = np.stack([np.column_stack([places, np.full(60, z)]) for z in (0.0, 4.0)], axis=1)
    lines = LineSet(ends, rng.normal(size=(60, 4)).astype(np.float32), np.full(60, 9, np.int64))
    height = np.arange(0.0, 4.0, 0.5)
    points = np.column_stack([np.repeat(places, 8, axis=0), np.tile(height, 60)])
    return LineMap.build(
        [lines.transformed(invert(pose)) for pose in poses],
        poses,
        np.tile([0.0, 0.0, 1.0], (8, 1)),
        [transform_points(invert(pose), points).astype(np.float32) for pose in poses],
        MapSettings(),
        MapOrigin(),
    )


def test_a_town_stands_in_the_large_map_as_it_is(town, tmp_path):
    large, (T_map_town,) = lay_out([town], 1000, seed=3)
    assert 1000 <= len(large) < 1000 + len(town)
    path = tmp_path / "large.sl3d"
    large.save(path)
    loaded = LineMap.load(path)  # the file checks counts, order and codes
    position = transform_points(T_map_town, np.array([[0.0, 3.0, 1.7]]))[0]
    here = loaded.cloud_near(position, 20.0)
    near = town.cloud_near(np.array([0, 3.0, 1.7]), 20.0).astype(np.float64)
    there = transform_points(T_map_town, near)
    np.testing.assert_allclose(np.sort(here[:, 0]), np.sort(there[:, 0]), atol=2e-3)
    ends = transform_points(T_map_town, town.lines.endpoints.reshape(-1, 3))
    gaps = np.abs(loaded.lines.endpoints.reshape(-1, 3)[:, None] - ends[None]).max(axis=2)
    assert (gaps.min(axis=0) < 2e-3).all()


def test_the_rest_is_stretched_by_six_percent_and_more(town):
    large, _ = lay_out([town], 600, seed=3)
    own = np.ptp(town.T_map_keyframe[:, 0, 3])
    drives = large.T_map_keyframe[:, :3, 3].reshape(-1, 8, 3)
    lengths = np.ptp(drives[:, :, 0], axis=1) / own
    assert np.sum(np.abs(lengths - 1.0) < 1e-6) == 1
    assert np.sum(np.abs(lengths - 1.0) > 0.059) == len(drives) - 1
    assert np.allclose(np.linalg.det(large.T_map_keyframe[:, :3, :3]), 1.0)


def test_figures_count_right_wrong_and_placed():
    def answer(inside, found, error_m=None, error_deg=None):
        return {
            "inside": inside, "found": found, "error_m": error_m, "error_deg": error_deg,
            "retrieval_ms": 2.0, "latency_ms": 10.0,
        }  # fmt: skip

    answers = [
        answer(True, True, 0.1, 0.2),
        answer(True, True, 0.1, 9.0),
        answer(True, True, 30.0, 0.1),
        answer(True, False),
        answer(False, False),
        answer(False, True),
    ]
    row = figures({"load_s": 1.0, "answers": answers})
    assert (row["asked"], row["right"], row["wrong"]) == (4, 1, 2)
    assert (row["outside"], row["placed"]) == (2, 1)
    assert row["median_m"] == pytest.approx(0.1)
    assert row["latency_p99_ms"] == pytest.approx(10.0)


def test_confidence_is_held_against_what_came_true():
    answers = [(0.95, True)] * 3 + [(0.91, False), (0.4, False), (1.0, True), (0.0, True)]
    rows = {row["confidence"]: row for row in reliability(answers).rows}
    assert rows["0.9 to 0.97"]["answers"] == 4
    assert rows["0.9 to 0.97"]["promised_percent"] == pytest.approx(94.0)
    assert rows["0.9 to 0.97"]["right_percent"] == pytest.approx(75.0)
    assert rows["0 to 0.5"]["right_percent"] == pytest.approx(50.0)
    assert rows["0.99 to 1"]["answers"] == 1  # a confidence of one belongs to the last
    assert rows["0.5 to 0.9"] == {"confidence": "0.5 to 0.9", "answers": 0}
    assert all(row["answers"] == 0 for row in reliability([]).rows)

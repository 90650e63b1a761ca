"""What a relocalizer asks of a map, and how far it trusts an answer."""

import numpy as np
import pytest

from sl3d_slam.config import LineSettings, MapSettings, SlamConfig
from sl3d_slam.errors import InputError
from sl3d_slam.geometry.se3 import (
    exp,
    from_yaw,
    invert,
    make_transform,
    transform_points,
)
from sl3d_slam.mapping.line_map import LineMap, MapOrigin
from sl3d_slam.mapping.places import Places, choose_places, place_frame
from sl3d_slam.relocalization.map_finder import confidence
from sl3d_slam.relocalization.relocalizer import Relocalizer
from sl3d_slam.types import LineSet

GEOMETRIC = SlamConfig(lines=LineSettings(method="geometric"))
TILT = exp(np.array([0.05, -0.08, 0.0, 0.0, 0.0, 0.0]))


def line_set(endpoints):
    endpoints = np.asarray(endpoints, float).reshape(-1, 2, 3)
    count = len(endpoints)
    return LineSet(endpoints, np.zeros((count, 4), np.float32), np.full(count, 20, np.int64))


def build(poses, landmarks_map, reach_m=40.0, clouds=True):
    """A map of upright landmarks, each seen by the keyframes within reach; the sensors lean."""
    seen, cloud_of = [], []
    for pose in poses:
        near = np.linalg.norm(landmarks_map - pose[:2, 3], axis=1) < reach_m
        ends = [np.column_stack([landmarks_map[near], np.full(near.sum(), z)]) for z in (-1.5, 3.0)]
        seen.append(line_set(np.stack(ends, axis=1)).transformed(invert(pose)))
        height = np.arange(-1.5, 3.0, 0.5)
        standing = np.repeat(landmarks_map[near], len(height), axis=0)
        column = np.column_stack([standing, np.tile(height, near.sum())])
        cloud_of.append(transform_points(invert(pose), column).astype(np.float32))
    ups = np.array([pose[2, :3] for pose in poses])
    settings = MapSettings(min_support=1, min_seen_share=0.0, cloud_min_keyframes=1)
    cloud_list = cloud_of if clouds else None
    return LineMap.build(seen, np.array(poses), ups, cloud_list, settings, MapOrigin())


@pytest.fixture
def poses():
    """A drive of 20 steps of 3 m along y; every sensor leans forward and to the side."""
    return [from_yaw(np.pi / 2, np.array([0.0, 3.0 * k, 0.0])) @ TILT for k in range(20)]


@pytest.fixture
def landmarks(rng):
    return np.column_stack([rng.uniform(-15, 15, 40), rng.uniform(-20, 80, 40)])


def test_places_are_more_than_6_m_apart_and_begin_with_the_first(poses, landmarks):
    chosen = choose_places(build(poses, landmarks))
    assert chosen.tolist() == [0, 3, 6, 9, 12, 15, 18]


def test_a_place_is_level_at_the_sensor_and_holds_upright_lines(poses, landmarks):
    line_map = build(poses, landmarks)
    T_map_place = place_frame(line_map, 9)
    np.testing.assert_allclose(T_map_place[:3, 3], poses[9][:3, 3], atol=1e-9)
    np.testing.assert_allclose(T_map_place[:3, 2], [0, 0, 1], atol=1e-3)  # ups are quantised
    view = Places(line_map).view(9)
    axes = view.lines.endpoints[:, 1] - view.lines.endpoints[:, 0]
    assert np.abs(axes[:, :2]).max() < 0.05
    np.testing.assert_array_equal(view.up, [0, 0, 1])


def test_a_place_shows_what_stands_around_it_where_it_stands(poses, landmarks):
    line_map = build(poses, landmarks)
    view = Places(line_map).view(9)
    T_map_place = place_frame(line_map, 9)
    found = transform_points(T_map_place, view.lines.endpoints.mean(axis=1))[:, :2]
    gaps = np.linalg.norm(found[:, None] - landmarks[None], axis=2).min(axis=1)
    assert gaps.max() < 0.05
    assert len(found) > 20
    cloud = transform_points(T_map_place, view.cloud.astype(float))[:, :2]
    assert np.linalg.norm(cloud[:, None] - landmarks[None], axis=2).min(axis=1).max() < 0.8


def test_only_landmarks_that_keyframes_nearby_saw_belong_to_a_place(poses, landmarks):
    """A wall between two streets: what the other street saw is not seen from here."""
    there = [make_transform(pose[:3, :3], pose[:3, 3] + [50.0, 0, 0]) for pose in poses]
    line_map = build(poses + there, landmarks, reach_m=30.0)
    rows = Places(line_map).landmarks(9)
    near = np.flatnonzero(np.abs(line_map.T_map_keyframe[:, 1, 3] - 27.0) <= 18.0)
    near = near[near < 20]
    assert set(rows) <= set(np.concatenate([line_map.seen_by(int(k)) for k in near]))


def test_a_map_without_cloud_or_landmarks_is_refused(poses, landmarks):
    with pytest.raises(InputError, match=r"map\.clouds"):
        Relocalizer(build(poses, landmarks, clouds=False), GEOMETRIC)
    with pytest.raises(InputError, match="no landmarks"):
        Relocalizer(build(poses, np.zeros((0, 2))), GEOMETRIC)


def test_a_scan_without_standing_lines_is_a_no(poses, landmarks, rng):
    flat = np.c_[rng.uniform(-30, 30, (5000, 2)), np.full(5000, -1.7)]
    answer = Relocalizer(build(poses, landmarks), GEOMETRIC).relocalize(flat)
    assert not answer.success
    assert answer.T_map_lidar is None
    assert "0 standing lines" in answer.reason


@pytest.mark.parametrize(
    "points", [np.zeros((10, 3)), np.full((200, 3), np.nan), np.zeros((99, 2))]
)
def test_what_is_no_scan_is_refused(poses, landmarks, points):
    relocalizer = Relocalizer(build(poses, landmarks), GEOMETRIC)
    with pytest.raises(InputError, match="points_lidar"):
        relocalizer.relocalize(points)


def test_confidence_grows_with_odds_and_with_the_lead_over_other_places():
    sure = confidence(12.0, 10.0)
    assert 0.99 < sure <= 1.0
    assert confidence(-1.92, 10.0) == pytest.approx(0.5, abs=0.01)  # as likely right as wrong
    assert confidence(12.0, 0.0) == pytest.approx(0.5, abs=1e-3)  # two places, equally likely
    assert confidence(2.0, 10.0) < sure
    assert confidence(12.0, 3.0) < sure
    assert 0.0 < confidence(-12.0, 2.0) < 0.01
    assert confidence(12.0, np.inf) == pytest.approx(1.0, abs=1e-3)  # no other place at all

import json
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from sl3d_slam.cli.main import app
from sl3d_slam.config import MapSettings
from sl3d_slam.errors import InputError
from sl3d_slam.geometry.se3 import exp, from_yaw, invert, transform_points
from sl3d_slam.geometry.segments import midpoints
from sl3d_slam.mapping.build import observations_of
from sl3d_slam.mapping.facts import area_m2, map_facts, street_steps
from sl3d_slam.mapping.line_map import LineMap, MapOrigin, landmark_up
from sl3d_slam.mapping.merge import standing
from sl3d_slam.types import LineKind, LineSet

POSE = exp(np.array([0.05, -0.1, 0.9, 50.0, -20.0, 3.0]))
WORLD = np.eye(4)
SETTINGS = MapSettings()


def poles(places, top_m=3.0):
    foot = np.column_stack([places, np.zeros(len(places))])
    return np.stack([foot, foot + np.array([0.0, 0.0, top_m])], axis=1)


def make_map(places, way, with_clouds=False, frame=WORLD):
    """A drive along ``way`` that sees all poles within 30 m; the map's frame is ``frame`` @ world.

    Every line's descriptor is its number in binary.
    """
    endpoints = poles(places)
    codes = ((np.arange(len(places))[:, None] >> np.arange(8)) & 1) * 2.0 - 1.0
    lines = LineSet(
        endpoints,
        (codes / np.sqrt(8)).astype(np.float32),
        np.full(len(places), 9, np.int64),
        np.full(len(places), LineKind.POLE, np.uint8),
    )
    poses = np.array([frame @ from_yaw(0.1 * k, np.append(p, 0.0)) for k, p in enumerate(way)])
    seen, clouds = [], []
    for T, place in zip(poses, way, strict=True):
        near = np.linalg.norm(np.asarray(places) - place, axis=1) < 30.0
        seen.append(lines.take(near).transformed(invert(T) @ frame))
        cloud = transform_points(invert(T) @ frame, endpoints[near].reshape(-1, 3))
        clouds.append(cloud.astype(np.float32))
    up = np.array([T[:3, :3].T @ frame[:3, :3] @ [0.0, 0.0, 1.0] for T in poses])
    return LineMap.build(seen, poses, up, clouds if with_clouds else None, SETTINGS)


def street(count, start_m=0.0):
    return np.array([[start_m + 9.0 * k, 6.0 * (-1) ** k] for k in range(count)])


def way_along(start_m, stop_m, y=0.0):
    x = np.arange(start_m, stop_m, 3.0)
    return np.column_stack([x, np.full(len(x), y)])


def places_of(line_map):
    return midpoints(line_map.lines.endpoints)


def test_who_saw_what():
    built = make_map(street(10), way_along(0, 90))
    for k, T in enumerate(built.T_map_keyframe):
        mine = built.seen_by(k)
        distance = np.linalg.norm(places_of(built)[:, :2] - T[:2, 3], axis=1)
        assert mine.tolist() == np.flatnonzero(distance < 30.0).tolist()
    assert built.support.sum() == len(built.indices) == built.offsets[-1]
    assert np.array_equal(built.support, np.bincount(built.indices))


def test_moving_the_frame_moves_everything_alike():
    here = make_map(street(10), way_along(0, 90), with_clouds=True)
    there = here.transformed(POSE)
    made_there = make_map(street(10), way_along(0, 90), with_clouds=True, frame=POSE)
    assert np.allclose(there.lines.endpoints, made_there.lines.endpoints, atol=1e-9)
    assert np.allclose(there.T_map_keyframe, made_there.T_map_keyframe, atol=1e-9)
    assert np.allclose(there.keyframe_up, made_there.keyframe_up, atol=1e-9)
    assert np.allclose(places_of(there), transform_points(POSE, places_of(here)), atol=1e-9)
    origin = POSE[:3, 3]
    near = there.cloud_near(origin, 12.0)
    expected = transform_points(POSE, here.cloud_near(np.zeros(3), 100.0).astype(float))
    apart = np.linalg.norm(near[:, None] - expected[None], axis=2).min(axis=1)
    assert len(near) > 0
    assert apart.max() < 3 * 0.8 / 32  # rounded twice to a 32nd of a voxel
    assert np.hypot(*(near[:, :2] - origin[:2]).T).max() < 12.0
    assert made_there.cloud_near(origin + np.array([0.0, 500.0, 0.0]), 12.0).shape == (0, 3)


def test_up_is_known_in_the_map_wherever_it_is_turned():
    rolled = exp(np.array([1.2, 0.4, -0.3, 5.0, 6.0, 7.0]))
    built = make_map(street(6), way_along(0, 30), frame=rolled)
    assert len(built) == 6
    assert np.allclose(landmark_up(built), rolled[:3, 2], atol=1e-9)
    lines = [built.lines.transformed(invert(T)) for T in built.T_map_keyframe]
    observed, _ = observations_of(lines, built.T_map_keyframe, built.keyframe_up)
    assert np.allclose(observed.up, rolled[:3, 2], atol=1e-9)
    assert standing(observed.lines.endpoints, observed.up).all()


def test_without_clouds_nothing_is_near():
    assert make_map(street(4), way_along(0, 30)).cloud_near(np.zeros(3), 9.0).shape == (0, 3)
    settings = MapSettings(clouds=False)
    built = LineMap.build([], np.zeros((0, 4, 4)), np.zeros((0, 3)), [], settings)
    assert built.cloud is None


def test_two_sessions_in_one_frame_become_one_map():
    first = make_map(street(10), way_along(0, 90), with_clouds=True)
    other_places = street(20)[5:]  # half of it the same street, half new
    second = make_map(other_places, way_along(60, 180), True, frame=POSE)
    joined = first.joined(second, invert(POSE), SETTINGS)
    assert len(joined) == 20
    apart = np.linalg.norm(places_of(joined)[:, None, :2] - street(20)[None], axis=2)
    assert apart.min(axis=1).max() < 1e-6
    assert len(joined.T_map_keyframe) == len(first.T_map_keyframe) + len(second.T_map_keyframe)
    assert np.allclose(joined.T_map_keyframe[30, :3, 3], [60.0, 0.0, 0.0], atol=1e-9)
    # landmarks 5 to 9 were seen by both; support adds up, and nobody else's changes
    both = apart.argmin(axis=0)
    assert joined.support[both[:5]].tolist() == first.support[:5].tolist()
    assert joined.support[both[5:10]].tolist() == (first.support[5:] + second.support[:5]).tolist()
    assert joined.support[both[10:]].tolist() == second.support[5:].tolist()
    assert set(joined.seen_by(30)) <= set(both[4:12].tolist())
    assert joined.cloud is not None
    assert len(joined.cloud) >= 2 * 20 - 2


def test_a_landmark_seen_more_often_moves_less():
    first = make_map([[30.0, 5.0]], way_along(6, 54))
    second = make_map([[30.0, 5.02]], way_along(24, 36))
    assert (first.support[0], second.support[0]) == (16, 4)
    joined = first.joined(second, np.eye(4), SETTINGS)
    assert joined.support.tolist() == [20]
    # the weighted mean; Cauchy weights at a sixth of their scale change it by under a millimetre
    assert places_of(joined)[0, 1] == pytest.approx(5.0 + 0.02 * 4 / 20, abs=0.001)


def test_what_was_gone_the_second_time_counts_for_less():
    gone = np.vstack([street(4), [[14.0, 2.0]]])
    first = make_map(gone, way_along(6, 18))
    second = make_map(street(4), way_along(0, 120, y=0.5))
    assert len(first) == 5
    strict = MapSettings(min_seen_share=0.3)
    joined = first.joined(second, np.eye(4), strict)
    assert len(joined) == 4
    assert np.linalg.norm(places_of(joined)[:, :2] - [14.0, 2.0], axis=1).min() > 3.0


def test_landmarks_and_cloud_follow_their_keyframes():
    built = make_map(street(40), way_along(0, 360), with_clouds=True)
    late = np.arange(len(built.T_map_keyframe)) >= 60  # from 180 m on
    shift = exp(np.array([0.0, 0.0, 0.0, 0.1, 0.3, -0.2]))
    poses = np.where(late[:, None, None], shift @ built.T_map_keyframe, built.T_map_keyframe)
    moved = built.reposed(poses)
    change = places_of(moved) - places_of(built)
    far = places_of(built)[:, 0] > 211.0  # out of sight of all early keyframes
    assert np.allclose(change[far], [0.1, 0.3, -0.2])
    assert np.allclose(change[places_of(built)[:, 0] < 148.0], 0.0)
    assert np.array_equal(moved.T_map_keyframe, poses)
    rigid = built.reposed(POSE @ built.T_map_keyframe)
    assert np.allclose(places_of(rigid), places_of(built.transformed(POSE)), atol=1e-9)
    cloud = rigid.cloud.all_points(), built.transformed(POSE).cloud.all_points()
    assert np.allclose(*cloud, atol=1e-4)


def test_maps_of_two_models_are_not_joined():
    first = make_map(street(4), way_along(0, 30))
    second = replace(first, origin=MapOrigin(model="learned abcd"))
    with pytest.raises(InputError, match="geometric and one of learned abcd"):
        first.joined(second, POSE, SETTINGS)


def test_unequal_inputs_are_named():
    lines = LineSet(poles([[1.0, 2.0]]), np.ones((1, 4), np.float32), np.ones(1, np.int64))
    other = replace(lines, descriptors=np.ones((1, 8), np.float32))
    poses, up = np.tile(POSE, (2, 1, 1)), np.tile([0.0, 0.0, 1.0], (2, 1))
    with pytest.raises(InputError, match="2 poses needs lines"):
        LineMap.build([lines], poses, up, None, SETTINGS)
    with pytest.raises(InputError, match="clouds of each"):
        LineMap.build([lines, lines], poses, up, [np.zeros((1, 3), np.float32)], SETTINGS)
    with pytest.raises(InputError, match="descriptors of one model"):
        LineMap.build([lines, other], poses, up, None, SETTINGS)


def test_a_street_driven_twice_counts_once():
    out, back = way_along(0, 300), way_along(0, 300, y=3.0)[::-1]
    steps_m, again = street_steps(np.column_stack([np.vstack([out, back]), np.zeros(200)]))
    assert np.isclose(steps_m.sum(), 2 * 297 + 3)
    # the first 50 m after turning round are too recent to be a revisit
    assert 297 <= steps_m[~again].sum() <= 297 + 53


def test_a_leap_between_two_drives_is_no_street():
    way = np.vstack([way_along(0, 100), way_along(5000, 5100)])
    steps_m, again = street_steps(np.column_stack([way, np.zeros(len(way))]))
    assert np.isclose(steps_m[~again].sum(), 2 * 99)


def test_area_of_a_straight_street():
    way = way_along(0, 1000)
    area = area_m2(np.column_stack([way, np.zeros(len(way))]))
    assert area == pytest.approx(1000 * 60 + np.pi * 900, rel=0.1)  # cells of 5 m


def test_facts_and_info(tmp_path):
    built = make_map(street(30), way_along(0, 270), with_clouds=True)
    path = tmp_path / "map.sl3d"
    built.save(path)
    facts = map_facts(LineMap.load(path))
    assert facts["landmarks"] == 30
    assert facts["landmarks_by_kind"]["pole"] == 30
    assert facts["street_km"] == pytest.approx(0.267, abs=1e-4)
    assert facts["size_kb"] == path.stat().st_size / 1e3
    assert 0 < facts["lines_kb"] < facts["size_kb"]
    assert facts["kb_per_km"] == pytest.approx(facts["size_kb"] / 0.267, rel=1e-3)
    shown = CliRunner().invoke(app, ["info", str(path), "--json"])
    assert shown.exit_code == 0
    assert json.loads(shown.output) == facts
    shown = CliRunner().invoke(app, ["info", str(path)])
    assert "landmarks by kind: 30 pole" in shown.output
    damaged = tmp_path / "damaged.sl3d"
    damaged.write_bytes(path.read_bytes()[:-1])
    refused = CliRunner().invoke(app, ["info", str(damaged)])
    assert refused.exit_code == 2
    assert "damaged.sl3d" in refused.stderr


def test_facts_of_an_empty_map():
    empty = LineMap.build([], np.zeros((0, 4, 4)), np.zeros((0, 3)), None, SETTINGS)
    facts = map_facts(empty)
    assert (facts["landmarks"], facts["street_km"], facts["kb_per_km"]) == (0, 0.0, None)

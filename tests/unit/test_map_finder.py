"""A view in a map, a place that is there twice, and two maps of one street."""

from dataclasses import replace

import numpy as np
import pytest

from sl3d_slam.config import SlamConfig
from sl3d_slam.errors import InputError
from sl3d_slam.geometry.se3 import (
    distance_m,
    exp,
    from_yaw,
    invert,
    rotation_angle_rad,
    transform_points,
)
from sl3d_slam.mapping.line_map import LineMap, MapOrigin
from sl3d_slam.relocalization.map_finder import MapFinder
from sl3d_slam.relocalization.merging import merge_maps
from sl3d_slam.types import LineSet, View

CONFIG = SlamConfig()
SENSOR_M = 1.7
REACH_M = 40.0


class Street:
    """A street along x: walls of many depths with corners, poles before them, level ground."""

    def __init__(self, seed, length_m=120.0):
        rng = np.random.default_rng(seed)
        self.posts = np.column_stack(
            [rng.uniform(0, length_m, 40), rng.choice([-1, 1], 40) * rng.uniform(4.5, 8.0, 40)]
        )
        corners, walls = [], []
        for side in (-1.0, 1.0):
            x = 0.0
            while x < length_m:
                width, depth = rng.uniform(4, 11), rng.uniform(9, 16)
                along = np.arange(x, x + width, 0.4)
                walls.append(np.column_stack([along, np.full(len(along), side * depth)]))
                across = np.arange(depth, 18.0, 0.4)
                walls.append(np.column_stack([np.full(len(across), x), side * across]))
                corners.append([x, side * depth])
                x += width
        self.uprights = np.concatenate([self.posts, corners])
        self.heights = rng.uniform(2.5, 6.0, len(self.uprights))
        self.descriptors = rng.normal(size=(len(self.uprights), 8)).astype(np.float32)
        self.descriptors /= np.linalg.norm(self.descriptors, axis=1, keepdims=True)
        z = np.arange(0.2, 5.0, 0.5)
        wall = np.concatenate(walls)
        grid = np.stack(np.meshgrid(np.arange(-5, length_m + 5, 0.7), np.arange(-8, 8, 0.7)), -1)
        ground = np.column_stack([grid.reshape(-1, 2), np.zeros(grid[..., 0].size)])
        self.points = np.concatenate(
            [
                np.column_stack([np.repeat(wall, len(z), axis=0), np.tile(z, len(wall))]),
                np.column_stack([np.repeat(self.posts, 8, axis=0), np.tile(z[:8], 40)]),
                ground,
            ]
        )

    def view(self, T_world_lidar, noise_m=0.03, seed=0):
        """What a sensor would keep there, in its own frame."""
        rng = np.random.default_rng(seed)
        T_lidar_world = invert(T_world_lidar)
        near = np.linalg.norm(self.uprights - T_world_lidar[:2, 3], axis=1) < REACH_M
        near &= rng.random(len(near)) < 0.8
        feet = np.column_stack([self.uprights[near], np.full(near.sum(), 0.1)])
        tops = np.column_stack([self.uprights[near], self.heights[near]])
        lines = LineSet(
            np.stack([feet, tops], axis=1) + rng.normal(0, noise_m, (len(feet), 1, 3)),
            self.descriptors[near],
            np.full(len(feet), 30, np.int64),
        ).transformed(T_lidar_world)
        shown = np.linalg.norm(self.points[:, :2] - T_world_lidar[:2, 3], axis=1) < REACH_M
        points = self.points[shown] + rng.normal(0, noise_m, (shown.sum(), 3))
        cloud = transform_points(T_lidar_world, points).astype(np.float32)
        return View(lines, T_lidar_world[:3, 2].copy(), cloud, points[:, 2].astype(np.float32))


def pose_at(x_m, y_m=-1.5, yaw_rad=0.0):
    return from_yaw(yaw_rad, np.array([x_m, y_m, SENSOR_M]))


def map_of(street, poses, T_map_world=None, drift=None):
    """A map of views at true poses, moved to another frame; ``drift`` bends it."""
    T_map_world = np.eye(4) if T_map_world is None else T_map_world
    views = [street.view(pose, seed=k) for k, pose in enumerate(poses)]
    placed = np.array([T_map_world @ pose for pose in poses])
    if drift is not None:
        placed = np.array([exp(drift * k) @ pose for k, pose in enumerate(placed)])
    return LineMap.build(
        [view.lines for view in views],
        placed,
        np.array([view.up for view in views]),
        [view.cloud for view in views],
        CONFIG.map,
        MapOrigin(simulated=True),
    )


@pytest.fixture(scope="module")
def street():
    return Street(3)


@pytest.fixture(scope="module")
def finder(street):
    return MapFinder(map_of(street, [pose_at(x) for x in np.arange(5, 115, 4.0)]), CONFIG)


@pytest.mark.parametrize(("x_m", "y_m", "yaw_deg"), [(23.0, 1.6, 178.0), (71.0, -0.5, -65.0)])
def test_a_view_is_found_from_the_other_lane_and_turned(finder, street, x_m, y_m, yaw_deg):
    T_truth = pose_at(x_m, y_m, np.radians(yaw_deg)) @ exp(np.array([0.03, -0.02, 0, 0, 0, 0.0]))
    answer = finder.find(street.view(T_truth, seed=99)).relocalization
    assert answer.success, answer.reason
    T_error = invert(T_truth) @ answer.T_map_lidar
    assert distance_m(T_error) < 0.15  # 3 cm noise, voxels of 0.8 m
    assert rotation_angle_rad(T_error) < np.radians(1.0)
    assert answer.confidence > 0.9


def test_a_view_of_another_street_is_a_no(finder):
    for seed in (11, 12):
        answer = finder.find(Street(seed).view(pose_at(60.0), seed=1)).relocalization
        assert not answer.success
        assert answer.reason


def test_a_street_that_is_there_twice_is_a_no(street):
    """Two blocks alike, 500 m apart: either would do, so neither is the answer."""
    shift = from_yaw(0.7, np.array([500.0, 40.0, 0.0]))
    here = [pose_at(x) for x in np.arange(30, 90, 4.0)]
    once = map_of(street, here)
    twice = once.joined(once, shift, CONFIG.map)
    view = street.view(pose_at(61.0, 0.5, 2.0), seed=50)
    assert MapFinder(once, CONFIG).find(view).relocalization.success
    answer = MapFinder(twice, CONFIG).find(view).relocalization
    assert not answer.success
    assert "equally well" in answer.reason


def test_even_lamps_between_even_walls_are_a_no():
    """Any answer could be a lamp further on."""
    lamps = Street(1)
    along = np.arange(0.0, 120.0, 10.0)
    lamps.uprights = np.concatenate([np.column_stack([along, np.full(12, s)]) for s in (-6.0, 6.5)])
    lamps.heights, lamps.descriptors = np.full(24, 5.0), np.ones((24, 1), np.float32)
    x, z = np.arange(-20, 140, 0.5), np.arange(0.2, 5, 0.5)
    wall = np.stack(np.meshgrid(x, z), -1).reshape(-1, 2)
    flat = np.stack(np.meshgrid(x, np.arange(-10, 10, 0.7)), -1).reshape(-1, 2)
    sides = [np.column_stack([wall[:, 0], np.full(len(wall), s), wall[:, 1]]) for s in (-10.0, 11)]
    posts = np.column_stack([np.repeat(lamps.uprights, len(z), axis=0), np.tile(z, 24)])
    ground = np.column_stack([flat, np.zeros(len(flat))])
    lamps.points = np.concatenate([*sides, posts, ground])
    line_map = map_of(lamps, [pose_at(x) for x in np.arange(0, 120, 4.0)])
    answer = MapFinder(line_map, CONFIG).find(lamps.view(pose_at(61.0), seed=4)).relocalization
    assert not answer.success


def test_two_sessions_are_joined_where_they_overlap(street):
    """The second map lies in a frame of its own, turned, and bends by 2 mm a keyframe."""
    T_second_world = from_yaw(2.4, np.array([-80.0, 33.0, 4.0]))
    bend = np.array([0.0, 0.0, 2e-4, 0.002, 0.0, 0.0])
    first = map_of(street, [pose_at(x) for x in np.arange(5, 80, 4.0)])
    there = [pose_at(x, 1.5, np.pi) for x in np.arange(115, 40, -4.0)]
    second = map_of(street, there, T_second_world, bend)
    merged = merge_maps(first, second, CONFIG)
    assert merged.line_map is not None, merged.reason
    T_error = T_second_world @ merged.T_first_second
    assert distance_m(T_error) < 1.5  # what the bend makes of 100 m of lever
    found = merged.line_map.T_map_keyframe[len(first.T_map_keyframe) :]
    gaps = [distance_m(invert(truth) @ pose) for truth, pose in zip(there, found, strict=True)]
    assert max(gaps[8:]) < 0.15  # the part that both saw; before it only the bent drive knows
    assert max(len(first), len(second)) < len(merged.line_map) < 0.8 * (len(first) + len(second))


def test_maps_that_do_not_overlap_or_differ_in_model_are_refused(street):
    here = map_of(street, [pose_at(x) for x in np.arange(5, 60, 4.0)])
    elsewhere = map_of(Street(21), [pose_at(x) for x in np.arange(5, 60, 4.0)])
    merged = merge_maps(here, elsewhere, CONFIG)
    assert merged.line_map is None
    assert "were found in the first" in merged.reason
    foreign = replace(here, origin=MapOrigin(model="superline3d-0123"))
    with pytest.raises(InputError, match="one model"):
        merge_maps(here, foreign, CONFIG)

"""A map cut into places: what a sensor would see around chosen keyframes, ready for matching."""

import numpy as np
from jaxtyping import Int64

from sl3d_slam.geometry.ground import heights_above_ground
from sl3d_slam.geometry.se3 import (
    Transform,
    invert,
    make_transform,
    rotation_between,
    transform_points,
)
from sl3d_slam.mapping.line_map import LineMap
from sl3d_slam.types import View

SPACING_M = 6.0
NEIGHBOURHOOD_M = 18.0
LINE_RADIUS_M = 55.0
CLOUD_RADIUS_M = 60.0
UP = np.array([0.0, 0.0, 1.0])


def choose_places(line_map: LineMap) -> Int64[np.ndarray, "P"]:
    """Return keyframes at least 6 m from every one chosen before them."""
    positions = line_map.T_map_keyframe[:, :3, 3]
    chosen: list[int] = []
    for k, position in enumerate(positions):
        if np.all(np.linalg.norm(positions[chosen] - position, axis=1) > SPACING_M):
            chosen.append(k)
    return np.array(chosen, np.int64)


def place_frame(line_map: LineMap, keyframe: int) -> Transform:
    """Return ``T_map_place``: at the keyframe's sensor, levelled, otherwise turned as the map."""
    T_map_keyframe = line_map.T_map_keyframe[keyframe]
    up_map = T_map_keyframe[:3, :3] @ line_map.keyframe_up[keyframe]
    return make_transform(rotation_between(UP, up_map), T_map_keyframe[:3, 3])


def place_landmarks(line_map: LineMap, keyframe: int) -> Int64[np.ndarray, "M"]:
    """Return the landmarks near a place that keyframes around it saw."""
    positions = line_map.T_map_keyframe[:, :3, 3]
    near = np.flatnonzero(np.linalg.norm(positions - positions[keyframe], axis=1) < NEIGHBOURHOOD_M)
    seen = np.unique(np.concatenate([line_map.seen_by(int(k)) for k in near]))
    middles = line_map.lines.endpoints[seen].mean(axis=1)
    gaps_m = np.linalg.norm((middles - positions[keyframe])[:, :2], axis=1)
    return seen[gaps_m < LINE_RADIUS_M]


def place_view(line_map: LineMap, keyframe: int) -> View:
    """Return what the map holds around a place, in the place's own frame."""
    T_place_map = invert(place_frame(line_map, keyframe))
    position = line_map.T_map_keyframe[keyframe, :3, 3]
    cloud_map = line_map.cloud_near(position, CLOUD_RADIUS_M).astype(np.float64)
    cloud = transform_points(T_place_map, cloud_map)
    heights = heights_above_ground(cloud, UP)
    lines = line_map.lines.take(place_landmarks(line_map, keyframe)).transformed(T_place_map)
    return View(lines, UP.copy(), cloud.astype(np.float32), heights.astype(np.float32))

"""A map cut into places: what a sensor would see around chosen keyframes, ready for matching."""

from itertools import chain

import numpy as np
from jaxtyping import Float64, Int32, Int64
from scipy.spatial import cKDTree

from sl3d_slam.geometry.ground import heights_above_ground
from sl3d_slam.geometry.se3 import (
    Transform,
    invert,
    make_transform,
    rotation_between,
    transform_points,
)
from sl3d_slam.mapping.line_map import LineMap
from sl3d_slam.mapping.place_members import strongest_members
from sl3d_slam.types import View

SPACING_M = 6.0
NEIGHBOURHOOD_M = 18.0
LINE_RADIUS_M = 55.0
CLOUD_RADIUS_M = 60.0
CHUNK = 8192  # places at a time
UP = np.array([0.0, 0.0, 1.0])


class Places:
    """The places of a map, found and shown in a time that does not grow with the map.

    Attributes
    ----------
    line_map : the map.
    keyframes : (P,) the keyframes that stand for a place each.
    T_level_map : the turn that makes the map level, as most of its keyframes saw it.
    """

    def __init__(self, line_map: LineMap) -> None:
        self.line_map = line_map
        self.keyframes = choose_places(line_map)
        self.T_level_map = make_transform(rotation_between(mean_up(line_map), UP), np.zeros(3))
        self._positions = line_map.T_map_keyframe[:, :3, 3]
        self._tree = cKDTree(self._positions)
        level = transform_points(self.T_level_map, self._positions[self.keyframes])
        self._from_above = cKDTree(level[:, :2])

    def nearest(self, x_m: float, y_m: float) -> int:
        """Return the keyframe of the place nearest to a point as seen from above.

        The point is given in the map's level frame.
        """
        return int(self.keyframes[self._from_above.query((x_m, y_m))[1]])

    def frame(self, keyframe: int) -> Transform:
        """Return ``T_map_place``, see :func:`place_frame`."""
        return place_frame(self.line_map, keyframe)

    def landmarks(self, keyframe: int) -> Int64[np.ndarray, "M"]:
        """Return the landmarks near a place that keyframes around it saw."""
        position = self._positions[keyframe]
        near = self._tree.query_ball_point(position, NEIGHBOURHOOD_M)
        seen = np.unique(np.concatenate([self.line_map.seen_by(k) for k in near]))
        middles = self.line_map.lines.endpoints[seen].mean(axis=1)
        gaps_m = np.hypot(*(middles - position)[:, :2].T)
        return seen[gaps_m < LINE_RADIUS_M]

    def strongest(self, ranks: Int64[np.ndarray, "L"], limit: int) -> Int32[np.ndarray, "P M"]:
        """Return the best-ranked landmarks of each place, a row each, -1 after the last.

        ``ranks`` of the map's landmarks: 0 the best, no two alike, -1 for one that does not count.
        """
        middles = self.line_map.lines.endpoints[:, :, :2].mean(axis=1)
        seen = (self.line_map.offsets, self.line_map.indices)
        parts = [np.zeros((0, limit), np.int32)]
        for first in range(0, len(self.keyframes), CHUNK):
            positions = self._positions[self.keyframes[first : first + CHUNK]]
            near = self._tree.query_ball_point(positions, NEIGHBOURHOOD_M)
            starts = np.cumsum([0, *map(len, near)])
            rows = np.fromiter(chain.from_iterable(near), np.int64, starts[-1])
            reach = (np.ascontiguousarray(positions[:, :2]), middles, LINE_RADIUS_M)
            parts.append(strongest_members((starts, rows), seen, ranks, reach, limit))
        return np.concatenate(parts)

    def view(self, keyframe: int) -> View:
        """Return what the map holds around a place, in the place's own frame."""
        T_place_map = invert(self.frame(keyframe))
        cloud_map = self.line_map.cloud_near(self._positions[keyframe], CLOUD_RADIUS_M)
        cloud = transform_points(T_place_map, cloud_map.astype(np.float64))
        heights = heights_above_ground(cloud, UP)
        lines = self.line_map.lines.take(self.landmarks(keyframe)).transformed(T_place_map)
        return View(lines, UP.copy(), cloud.astype(np.float32), heights.astype(np.float32))


def choose_places(line_map: LineMap) -> Int64[np.ndarray, "P"]:
    """Return keyframes at least 6 m from every one chosen before them."""
    positions = line_map.T_map_keyframe[:, :3, 3]
    tree = cKDTree(positions)
    taken = np.zeros(len(positions), np.bool_)
    chosen = []
    for first in range(0, len(positions), CHUNK):
        near = tree.query_ball_point(positions[first : first + CHUNK], SPACING_M)
        for k, rows in enumerate(near, first):
            if not taken[k]:
                chosen.append(k)
                taken[rows] = True
    return np.array(chosen, np.int64)


def place_frame(line_map: LineMap, keyframe: int) -> Transform:
    """Return ``T_map_place``: at the keyframe's sensor, levelled, otherwise turned as the map."""
    T_map_keyframe = line_map.T_map_keyframe[keyframe]
    up_map = T_map_keyframe[:3, :3] @ line_map.keyframe_up[keyframe]
    return make_transform(rotation_between(UP, up_map), T_map_keyframe[:3, 3])


def mean_up(line_map: LineMap) -> Float64[np.ndarray, "3"]:
    """Return the mean way up of all keyframes, in the map frame; z where there is none."""
    up = np.einsum("kij,kj->i", line_map.T_map_keyframe[:, :3, :3], line_map.keyframe_up)
    norm = float(np.linalg.norm(up))
    return up / norm if norm > 1e-9 else UP.copy()

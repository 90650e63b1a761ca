"""A view with everything that matching derives from it, each part made when first needed."""

from copy import copy
from dataclasses import replace
from functools import cached_property

import numpy as np
import small_gicp
from jaxtyping import Float32, Float64

from sl3d_slam.config import MatchingSettings
from sl3d_slam.geometry.facing import faces_its_beam
from sl3d_slam.geometry.se3 import Points, Transform, from_yaw, invert, transform_points
from sl3d_slam.matching import dense, field, refine, visibility
from sl3d_slam.matching.dense import MovingClouds
from sl3d_slam.matching.verticals import Verticals, find_verticals, levelling
from sl3d_slam.types import LineSet, View

GROUND_REACH_M = 8.0
MIN_GROUND_POINTS = 50
RASTER_CELL_M = 1.0
RASTER_SIZE = 160
OF_THE_LINES = ("verticals", "slope")


class PreparedView:
    """One side of a match. Two threads must not share one."""

    def __init__(self, view: View, settings: MatchingSettings) -> None:
        self.view = view
        self._max_angle_rad = np.radians(2.0 * settings.angle_tolerance_deg)

    def with_lines(self, lines: LineSet) -> "PreparedView":
        """Return the same view with other lines of the same scan, levelled alike."""
        other = copy(self)
        other.view = replace(self.view, lines=lines)
        for name in OF_THE_LINES:
            vars(other).pop(name, None)
        return other

    def prepare(self, moves: bool) -> "PreparedView":
        """Make now what registration needs of the side that moves, or of the other; return self."""
        _ = self.verticals, self.field, self.image, self.level_structure, self.street_raster
        _ = self.moving if moves else self.dense
        return self

    @cached_property
    def T_level_lidar(self) -> Transform:
        """The turn that makes the frame level."""
        return levelling(self.view.up)

    @cached_property
    def slope(self) -> Float64[np.ndarray, "2"] | None:
        """How much the ground rises a metre along x and y of the levelled frame; lines say."""
        if self.view.lines.ground_up is None:
            return None
        normal = self.T_level_lidar[:3, :3] @ self.view.lines.ground_up
        return -normal[:2] / normal[2]

    @cached_property
    def verticals(self) -> Verticals:
        """The standing lines, in the levelled frame."""
        return find_verticals(self.view.lines, self.T_level_lidar, self._max_angle_rad)

    @cached_property
    def level_points(self) -> Points:
        """The coarse cloud in the levelled frame."""
        return transform_points(self.T_level_lidar, self.view.cloud.astype(np.float64))

    @cached_property
    def level_structure(self) -> Points:
        """What stands above the street; the street itself agrees with any pose on it."""
        return self.level_points[self.view.heights > field.STRUCTURE_M[0]]

    @cached_property
    def field(self) -> field.StructureField:
        """The coarse cloud seen from above."""
        return field.build_field(self.level_points, self.view.heights)

    @cached_property
    def image(self) -> visibility.RangeImage:
        """The coarse cloud seen from the sensor."""
        return visibility.range_image(self.level_points)

    @cached_property
    def _seen(self) -> Float32[np.ndarray, "M 3"]:
        """The coarse cloud without what its beams met edge-on."""
        points = self.view.cloud.astype(np.float64)
        return self.view.cloud[faces_its_beam(points, dense.NEIGHBOURS)]

    @cached_property
    def dense(self) -> dense.DenseCloud | None:
        """The coarse cloud for others to be aligned to; None where it has too few points."""
        return dense.prepare(self._seen)

    @cached_property
    def thinned(self) -> MovingClouds | None:
        """The coarse cloud to be moved in stages; None where it has too few points."""
        return dense.thin(self._seen)

    @cached_property
    def street(self) -> Points:
        """The coarse cloud's points on the ground, in the levelled frame."""
        return self.level_points[np.abs(self.view.heights) < field.GROUND_M]

    @cached_property
    def street_raster(self) -> np.ndarray:
        """The ground's mean height in square cells around the sensor; NaN where none is seen."""
        cells, inside = _cells(self.street)
        heights_m = self.street[inside, 2]
        shape = (RASTER_SIZE, RASTER_SIZE)
        index = np.ravel_multi_index((cells[:, 0], cells[:, 1]), shape)
        counts = np.bincount(index, minlength=RASTER_SIZE**2)
        sums = np.bincount(index, heights_m, minlength=RASTER_SIZE**2)
        return np.where(counts > 0, sums / np.maximum(counts, 1), np.nan).reshape(shape)

    @cached_property
    def moving(self) -> small_gicp.PointCloud | None:
        """The coarse cloud thinned to be moved by GICP; None where it has too few points."""
        return refine.moving_cloud(self.view.cloud)

    def ground_height_m(self, x_m: float, y_m: float) -> float | None:
        """Return the ground's height around a place in the levelled frame; None if hardly seen."""
        near = np.hypot(self.street[:, 0] - x_m, self.street[:, 1] - y_m) < GROUND_REACH_M
        if near.sum() < MIN_GROUND_POINTS:
            return None
        return float(np.median(self.street[near, 2]))


def lift(source: PreparedView, target: PreparedView, pose: np.ndarray) -> Transform:
    """Turn a planar pose (yaw, x, y) of levelled frames into ``T_target_source``.

    The ground gives the height: the source's own ground is laid on the target's there, or, where
    the target hardly sees any there, all ground that both see; without clouds the slopes that lines
    come with. (A few far returns are no ground: on drive 05 they put poses 40 m away up to 2.8 m
    too high.)
    """
    yaw_rad, x_m, y_m = (float(value) for value in pose)
    theirs, own = target.ground_height_m(x_m, y_m), source.ground_height_m(0.0, 0.0)
    if len(source.street) == 0 or len(target.street) == 0:
        rise_m = slope_rise_m(source, target, pose)
    elif theirs is None or own is None:
        flat = from_yaw(yaw_rad, np.array([x_m, y_m, 0.0]))
        rise_m = common_rise_m(source, target, flat)
    else:
        rise_m = theirs - own
    T_levels = from_yaw(yaw_rad, np.array([x_m, y_m, rise_m]))
    return invert(target.T_level_lidar) @ T_levels @ source.T_level_lidar


def common_rise_m(source: PreparedView, target: PreparedView, T_levels: Transform) -> float:
    """Return by how much the source must rise to lie on the ground that both see; 0 without any."""
    moved = transform_points(T_levels, source.street)
    cells, inside = _cells(moved)
    gaps_m = target.street_raster[cells[:, 0], cells[:, 1]] - moved[inside, 2]
    gaps_m = gaps_m[np.isfinite(gaps_m)]
    return float(np.median(gaps_m)) if len(gaps_m) >= MIN_GROUND_POINTS else 0.0


def slope_rise_m(source: PreparedView, target: PreparedView, pose: np.ndarray) -> float:
    """Return how much higher the ground is at the source, by the slopes at both ends; 0 without.

    Their mean is that of a parabola; where one is not known, the other is taken for both.
    """
    way_back = field.invert_poses(pose[None])[0, 1:]
    ends = ((target.slope, pose[1:]), (source.slope, -way_back))
    rises_m = [float(slope @ way) for slope, way in ends if slope is not None]
    return sum(rises_m) / max(1, len(rises_m))


def _cells(points_level: Points) -> tuple[np.ndarray, np.ndarray]:
    """Return the raster cells of points, and which of the points lie on the raster."""
    cells = np.floor(points_level[:, :2] / RASTER_CELL_M).astype(np.int64) + RASTER_SIZE // 2
    inside = np.all((cells >= 0) & (cells < RASTER_SIZE), axis=1)
    return cells[inside], inside


def flatten(source: PreparedView, target: PreparedView, T_target_source: Transform) -> np.ndarray:
    """Return the planar pose (yaw, x, y) of levelled frames; the inverse of :func:`lift`."""
    T_levels = target.T_level_lidar @ T_target_source @ invert(source.T_level_lidar)
    return np.array([np.arctan2(T_levels[1, 0], T_levels[0, 0]), T_levels[0, 3], T_levels[1, 3]])

"""What is kept of a scan, small: lines, the way up and a coarse cloud with heights."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float16, Float64, Int16
from safetensors.numpy import load, save

from sl3d_slam.geometry.ground import heights_above_ground, up_direction
from sl3d_slam.geometry.se3 import Points
from sl3d_slam.matching.dense import coarse_cloud
from sl3d_slam.types import LineSet, View

CENTIMETRE = 0.01
LINE_COLUMNS = ("endpoints", "descriptors", "num_points", "kinds", "scores")


@dataclass(frozen=True, slots=True, eq=False)
class PackedView:
    """A view at 8 bytes a point: centimetres and half-precision heights."""

    lines: LineSet
    up: Float64[np.ndarray, "3"]
    cloud_cm: Int16[np.ndarray, "N 3"]
    heights: Float16[np.ndarray, "N"]


def make_view(points_lidar: Points, lines: LineSet, voxel_m: float) -> View:
    """Keep what matching needs of a scan; the cloud has one point a voxel, within 70 m."""
    ground_up = up_direction(points_lidar) if lines.ground_up is None else lines.ground_up
    cloud = coarse_cloud(points_lidar, voxel_m)
    heights = heights_above_ground(cloud.astype(np.float64), ground_up)
    up = ground_up if lines.up is None else lines.up
    return View(lines, up, cloud, heights.astype(np.float32))


def view_of_lines(lines: LineSet, up: Float64[np.ndarray, "3"]) -> View:
    """Return a view that has no cloud."""
    return View(lines, up, np.zeros((0, 3), np.float32), np.zeros(0, np.float32))


def pack(view: View) -> PackedView:
    """Store a view compactly."""
    cloud_cm = np.round(view.cloud / CENTIMETRE).astype(np.int16)
    return PackedView(view.lines, view.up, cloud_cm, view.heights.astype(np.float16))


def to_bytes(packed: PackedView) -> bytes:
    """Write a packed view in the safetensors format."""
    lines = packed.lines
    columns = {f"lines.{name}": getattr(lines, name) for name in LINE_COLUMNS}
    rest = {"up": packed.up, "cloud_cm": packed.cloud_cm, "heights": packed.heights}
    return save({name: np.ascontiguousarray(array) for name, array in (columns | rest).items()})


def from_bytes(raw: bytes) -> PackedView:
    """Undo :func:`to_bytes`, exactly."""
    arrays = load(raw)
    lines = LineSet(**{name: arrays[f"lines.{name}"] for name in LINE_COLUMNS})
    return PackedView(lines, arrays["up"], arrays["cloud_cm"], arrays["heights"])


def unpack(packed: PackedView) -> View:
    """Undo :func:`pack`, to the centimetre."""
    cloud = packed.cloud_cm.astype(np.float32) * np.float32(CENTIMETRE)
    return View(packed.lines, packed.up, cloud, packed.heights.astype(np.float32))

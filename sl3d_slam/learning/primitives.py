"""The two shapes that hold every line of a street: a corner of planes, and a pole on a base.

Superline3D, section 3.1: lines worth finding are where planes meet and where something slender
stands. A shape is a few parallelograms and cylinders in metres, z up; points are drawn evenly over
its surface, and what line a point belongs to follows from geometry alone.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64, UInt8

from sl3d_slam.geometry.se3 import Points, Transform, transform_points
from sl3d_slam.types import LineKind

BACKGROUND = -1
WALL_LENGTH_M = (2.0, 10.0)
WALL_HEIGHT_M = (2.0, 8.0)
WALL_ANGLE_DEG = (60.0, 120.0)
POLE_LENGTH_M = (1.5, 8.0)
POLE_RADIUS_M = (0.03, 0.2)
POLE_LEAN_DEG = 3.0
BASE_SIDE_M = (3.0, 10.0)
ROOFED_SHARE = 0.3
UPRIGHT_SINE = 0.9


@dataclass(frozen=True, slots=True, eq=False)
class Primitive:
    """A shape and its true lines.

    Attributes
    ----------
    faces : (F, 3, 3) one corner and two sides of each parallelogram.
    cylinders : (C, 3, 3) foot, axis from foot to top, and (radius, 0, 0).
    edges : (E, 2, 3) where faces meet; the first lines.
    """

    faces: Float64[np.ndarray, "F 3 3"]
    cylinders: Float64[np.ndarray, "C 3 3"]
    edges: Float64[np.ndarray, "E 2 3"]

    @property
    def lines(self) -> Float64[np.ndarray, "L 2 3"]:
        """All true lines: the edges, then the axes of the cylinders."""
        feet = self.cylinders[:, 0]
        axes = np.stack([feet, feet + self.cylinders[:, 1]], axis=1)
        return np.concatenate([self.edges, axes])

    @property
    def kinds(self) -> UInt8[np.ndarray, "L"]:
        """What each line is, values of :class:`LineKind`."""
        along = self.edges[:, 1] - self.edges[:, 0]
        upright = np.abs(along[:, 2]) > UPRIGHT_SINE * np.linalg.norm(along, axis=1)
        edges = np.where(upright, LineKind.VERTICAL_EDGE, LineKind.OTHER_EDGE)
        poles = np.full(len(self.cylinders), LineKind.POLE)
        return np.concatenate([edges, poles]).astype(np.uint8)

    @property
    def areas_m2(self) -> Float64[np.ndarray, "A"]:
        """The area of every face, then of every cylinder without its caps."""
        sides = np.cross(self.faces[:, 1], self.faces[:, 2])
        lengths = np.linalg.norm(self.cylinders[:, 1], axis=1)
        tubes = 2.0 * np.pi * self.cylinders[:, 2, 0] * lengths
        return np.concatenate([np.linalg.norm(sides, axis=1), tubes])

    @property
    def size_m(self) -> float:
        """The longest side of the box around the shape, the unit of its perturbation."""
        corners = self.faces[:, :1] + np.stack(
            [np.zeros_like(self.faces[:, 0]), self.faces[:, 1], self.faces[:, 2]], axis=1
        )
        ends = np.concatenate([corners.reshape(-1, 3), self.lines.reshape(-1, 3)])
        return float(np.ptp(ends, axis=0).max())

    def moved(self, T_cloud_primitive: Transform) -> "Primitive":
        """Return the shape turned and shifted; directions turn only."""
        R = T_cloud_primitive[:3, :3]
        faces, cylinders = self.faces @ R.T, self.cylinders.copy()
        faces[:, 0] += T_cloud_primitive[:3, 3]
        cylinders[:, :2] = cylinders[:, :2] @ R.T
        cylinders[:, 0] += T_cloud_primitive[:3, 3]
        edges = transform_points(T_cloud_primitive, self.edges.reshape(-1, 3))
        return Primitive(faces, cylinders, edges.reshape(-1, 2, 3))


def make_corner(rng: np.random.Generator) -> Primitive:
    """Return three planes that meet in a point: two walls and the ground between, or a roof.

    Its three lines are the edge between the walls and the feet (or tops) of both walls. The free
    borders of the planes are no lines: so end the parts of a wall that something hides.
    """
    a_m, b_m = rng.uniform(*WALL_LENGTH_M, 2)
    height_m = rng.uniform(*WALL_HEIGHT_M)
    turn = np.radians(rng.uniform(*WALL_ANGLE_DEG))
    along_a = a_m * np.array([1.0, 0.0, 0.0])
    along_b = b_m * np.array([np.cos(turn), np.sin(turn), 0.0])
    up = np.array([0.0, 0.0, -height_m if rng.random() < ROOFED_SHARE else height_m])
    apex = np.zeros(3)
    faces = np.array([[apex, along_a, up], [apex, along_b, up], [apex, along_a, along_b]])
    edges = np.array([[apex, up], [apex, along_a], [apex, along_b]])
    return Primitive(faces, np.zeros((0, 3, 3)), edges)


def make_pole(rng: np.random.Generator) -> Primitive:
    """Return a slender cylinder that stands on a square base; its one line is the axis."""
    side_m, length_m = rng.uniform(*BASE_SIDE_M), rng.uniform(*POLE_LENGTH_M)
    radius_m = np.exp(rng.uniform(*np.log(POLE_RADIUS_M)))
    foot = np.array([*rng.uniform(0.1, 0.9, 2) * side_m, 0.0])
    lean = np.tan(np.radians(rng.uniform(-POLE_LEAN_DEG, POLE_LEAN_DEG, 2)))
    axis = length_m * np.array([*lean, 1.0])
    base = np.array([[[0.0, 0.0, 0.0], [side_m, 0.0, 0.0], [0.0, side_m, 0.0]]])
    return Primitive(base, np.array([[foot, axis, [radius_m, 0, 0]]]), np.zeros((0, 2, 3)))


def sample_surface(
    primitive: Primitive, count: int, reach_m: float, rng: np.random.Generator
) -> tuple[Points, Int64[np.ndarray, "N"]]:
    """Draw points evenly over a shape; return them and the row of the line each belongs to.

    A point of a face belongs to the nearest edge within ``reach_m``, a point of a cylinder to its
    axis, any other to none (-1).
    """
    areas = primitive.areas_m2
    part = rng.choice(len(areas), count, p=areas / areas.sum())
    num_faces = len(primitive.faces)
    on_face = part < num_faces
    points = np.empty((count, 3))
    line_id = np.full(count, BACKGROUND, np.int64)
    faces = primitive.faces[part[on_face]]
    shares = rng.random((len(faces), 2))
    points[on_face] = faces[:, 0] + np.einsum("ns,nsd->nd", shares, faces[:, 1:])
    if len(primitive.edges):
        distance = distances_to_segments_m(points[on_face], primitive.edges)
        nearest = distance.argmin(axis=1)
        line_id[on_face] = np.where(distance.min(axis=1) <= reach_m, nearest, BACKGROUND)
    tubes = part[~on_face] - num_faces
    points[~on_face] = _on_cylinders(primitive.cylinders[tubes], rng)
    line_id[~on_face] = len(primitive.edges) + tubes
    return points, line_id


def distances_to_segments_m(
    points: Points, segments: Float64[np.ndarray, "L 2 3"]
) -> Float64[np.ndarray, "N L"]:
    """Return the distance of each point from each segment."""
    along = segments[:, 1] - segments[:, 0]
    squared = np.maximum(np.einsum("ld,ld->l", along, along), 1e-12)
    offset = points[:, None] - segments[None, :, 0]
    share = np.clip(np.einsum("nld,ld->nl", offset, along) / squared, 0.0, 1.0)
    return np.linalg.norm(offset - share[..., None] * along, axis=2)


def _on_cylinders(cylinders: Float64[np.ndarray, "N 3 3"], rng: np.random.Generator) -> Points:
    """Draw one point on the side of each cylinder."""
    foot, axis, radius = cylinders[:, 0], cylinders[:, 1], cylinders[:, 2, :1]
    unit = axis / np.maximum(np.linalg.norm(axis, axis=1, keepdims=True), 1e-12)
    across = np.cross(unit, np.eye(3)[np.argmin(np.abs(unit), axis=1)])
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)
    angle = rng.uniform(0.0, 2.0 * np.pi, (len(cylinders), 1))
    height = rng.random((len(cylinders), 1))
    outward = np.cos(angle) * across + np.sin(angle) * np.cross(unit, across)
    return foot + height * axis + radius * outward

"""What a town is made of: boxes, cylinders, patches and ellipsoids, and the true lines on them.

Everything is in the town frame (x, y, z up, metres). A primitive is one row of numbers:

====================  ==================================================================
box (turned about z)  0:3 centre, 3 cos yaw, 4 sin yaw, 5:8 half extents
cylinder (no caps)    0:3 foot, 3:6 unit axis, 6 length, 7 radius
patch (u, v plane)    0:3 corner, 3:6 unit u, 6:9 unit v, 9:12 normal, 12 size u, 13 size v,
                      14 taper (0 rectangle, 1 triangle with the apex at the top),
                      15 window pitch u, 16 width, 17 pitch v, 18 height, 19 depth (0: none)
ellipsoid             0:3 centre, 3:6 radii
====================  ==================================================================

``density`` is 0 for a solid. A box or ellipsoid with a density is foliage: a ray goes on average
1 / density metres into it. A patch with a density stops that share of the rays (a wire fence).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int64, UInt8

from sl3d_slam.types import LineKind

BOX, CYLINDER, PATCH, ELLIPSOID = 0, 1, 2, 3
NUM_PARAMETERS = 20
NO_LINE = -1
Vector = Sequence[float] | np.ndarray


class Semantic(IntEnum):
    """What a point lies on; the numbers are SemanticKITTI's where it has one."""

    CAR = 10
    PERSON = 30
    ROAD = 40
    PARKING = 44
    SIDEWALK = 48
    BUILDING = 50
    FENCE = 51
    OTHER_STRUCTURE = 52
    VEGETATION = 70
    TRUNK = 71
    TERRAIN = 72
    POLE = 80
    SIGN = 81
    OTHER_OBJECT = 99
    MOVING_CAR = 252
    MOVING_PERSON = 254


class Material(NamedTuple):
    """Semantic class, reflectivity in [0, 1] and density (0: solid)."""

    semantic: int
    reflectivity: float
    density: float = 0.0


class Windows(NamedTuple):
    """A grid of windows in a wall, metres; ``depth_m`` 0 means a plain wall."""

    pitch_u_m: float = 1.0
    width_m: float = 0.0
    pitch_v_m: float = 1.0
    height_m: float = 0.0
    depth_m: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class TrueLines:
    """Where straight structure really is: town frame, metres.

    Attributes
    ----------
    endpoints : (L, 2, 3); the order of the two end points carries no meaning.
    kinds : (L,) values of :class:`sl3d_slam.types.LineKind`.
    semantics : (L,) values of :class:`Semantic`: what the line is an edge or an axis of.
    """

    endpoints: Float64[np.ndarray, "L 2 3"]
    kinds: UInt8[np.ndarray, "L"]
    semantics: UInt8[np.ndarray, "L"]


@dataclass(frozen=True, slots=True, eq=False)
class Primitives:
    """P primitives as columns; ``edges`` holds line ids, -1 where there is none."""

    kinds: UInt8[np.ndarray, "P"]
    parameters: Float64[np.ndarray, "P 20"]
    materials: Float64[np.ndarray, "P 3"]
    edges: Int64[np.ndarray, "P 4"]

    def __len__(self) -> int:
        """Return the number of primitives."""
        return len(self.kinds)


@dataclass(slots=True, eq=False)
class SceneBuilder:
    """Collects primitives and lines; :meth:`primitives` and :meth:`lines` freeze them."""

    rows: list[tuple[int, list[float], Material, Sequence[int]]] = field(default_factory=list)
    segments: list[tuple[Vector, Vector, int, int]] = field(default_factory=list)

    def line(self, start: Vector, end: Vector, kind: LineKind, semantic: Semantic) -> int:
        """Record a true line and return its id."""
        self.segments.append((start, end, int(kind), int(semantic)))
        return len(self.segments) - 1

    def box(self, centre: Vector, yaw_rad: float, half: Vector, material: Material) -> None:
        """Add an upright box, turned about z."""
        values = [*centre, np.cos(yaw_rad), np.sin(yaw_rad), *half]
        self.rows.append((BOX, values, material, (NO_LINE,) * 4))

    def cylinder(
        self, foot: Vector, top: Vector, radius: float, material: Material, line: int = NO_LINE
    ) -> None:
        """Add the mantle of a cylinder between two points; its points belong to ``line``."""
        axis = np.subtract(top, foot)
        length = float(np.linalg.norm(axis))
        values = [*foot, *(axis / length), length, radius]
        self.rows.append((CYLINDER, values, material, (line,) * 4))

    def patch(
        self,
        sides: tuple[Vector, Vector, Vector],
        material: Material,
        taper: float = 0.0,
        windows: Windows | None = None,
        edges: Sequence[int] = (NO_LINE,) * 4,
    ) -> None:
        """Add a flat patch: ``sides`` are its corner and the vectors u and v that span it.

        ``edges`` are the line ids at u = 0, u = size, v = 0 and v = size.
        """
        corner, u, v = (np.asarray(side, float) for side in sides)
        size_u, size_v = float(np.linalg.norm(u)), float(np.linalg.norm(v))
        unit_u, unit_v = u / size_u, v / size_v
        normal = np.cross(unit_u, unit_v)
        openings = windows if windows is not None else Windows()
        values = [*corner, *unit_u, *unit_v, *normal, size_u, size_v, taper, *openings]
        self.rows.append((PATCH, values, material, tuple(edges)))

    def ellipsoid(self, centre: Vector, radii: Vector, material: Material) -> None:
        """Add an ellipsoid whose axes are those of the town."""
        self.rows.append((ELLIPSOID, [*centre, *radii], material, (NO_LINE,) * 4))

    def primitives(self) -> Primitives:
        """Return what was added, in order."""
        parameters = np.zeros((len(self.rows), NUM_PARAMETERS))
        for row, (_, values, _, _) in zip(parameters, self.rows, strict=True):
            row[: len(values)] = values
        return Primitives(
            np.array([row[0] for row in self.rows], np.uint8),
            parameters,
            np.array([row[2] for row in self.rows], np.float64).reshape(-1, 3),
            np.array([row[3] for row in self.rows], np.int64).reshape(-1, 4),
        )

    def lines(self) -> TrueLines:
        """Return the recorded lines; the id of a line is its row."""
        pairs = [(segment[0], segment[1]) for segment in self.segments]
        return TrueLines(
            np.array(pairs, np.float64).reshape(-1, 2, 3),
            np.array([segment[2] for segment in self.segments], np.uint8),
            np.array([segment[3] for segment in self.segments], np.uint8),
        )


def joined(parts: Sequence[Primitives]) -> Primitives:
    """Return the primitives of all parts, in order; line ids stay as they are."""
    return Primitives(
        np.concatenate([part.kinds for part in parts]),
        np.vstack([part.parameters for part in parts]),
        np.vstack([part.materials for part in parts]),
        np.vstack([part.edges for part in parts]),
    )


def bounds(primitives: Primitives) -> Float64[np.ndarray, "P 6"]:
    """Return the axis-aligned box of each primitive: low x, y, z, high x, y, z."""
    p = primitives.parameters
    low, high = np.zeros((len(p), 3)), np.zeros((len(p), 3))
    box = primitives.kinds == BOX
    spread = np.abs(p[box][:, 3:5])
    half = np.stack(
        [
            spread[:, 0] * p[box][:, 5] + spread[:, 1] * p[box][:, 6],
            spread[:, 1] * p[box][:, 5] + spread[:, 0] * p[box][:, 6],
            p[box][:, 7],
        ],
        axis=1,
    )
    low[box], high[box] = p[box][:, :3] - half, p[box][:, :3] + half
    cylinder = primitives.kinds == CYLINDER
    foot, radius = p[cylinder][:, :3], p[cylinder][:, 7:8]
    top = foot + p[cylinder][:, 3:6] * p[cylinder][:, 6:7]
    low[cylinder] = np.minimum(foot, top) - radius
    high[cylinder] = np.maximum(foot, top) + radius
    patch = primitives.kinds == PATCH
    u, v = p[patch][:, 3:6] * p[patch][:, 12:13], p[patch][:, 6:9] * p[patch][:, 13:14]
    corners = p[patch][:, None, :3] + np.stack([0 * u, u, v, u + v], axis=1)
    low[patch], high[patch] = corners.min(axis=1) - 0.01, corners.max(axis=1) + 0.01
    ellipsoid = primitives.kinds == ELLIPSOID
    low[ellipsoid] = p[ellipsoid][:, :3] - p[ellipsoid][:, 3:6]
    high[ellipsoid] = p[ellipsoid][:, :3] + p[ellipsoid][:, 3:6]
    return np.concatenate([low, high], axis=1)

"""Roofs: gabled, hipped or flat, with their true edges."""

import numpy as np

from sl3d_slam.simulation.primitives import NO_LINE, Material, SceneBuilder, Semantic, Vector
from sl3d_slam.simulation.walls import UP, Lot
from sl3d_slam.types import LineKind


def _slope(
    builder: SceneBuilder, eaves: tuple[Vector, Vector], ridge: tuple[Vector, Vector], taper: float
) -> None:
    """Add one side of a roof between an eaves line and a ridge line (given in the same sense)."""
    tiles = Material(Semantic.BUILDING, 0.3)
    low = builder.line(eaves[0], eaves[1], LineKind.OTHER_EDGE, Semantic.BUILDING)
    high = NO_LINE
    if taper < 1.0:
        high = builder.line(ridge[0], ridge[1], LineKind.OTHER_EDGE, Semantic.BUILDING)
    along = np.subtract(eaves[1], eaves[0])
    unit = along / np.linalg.norm(along)
    rise = np.subtract(ridge[0], eaves[0])
    rise = rise - (rise @ unit) * unit
    builder.patch((eaves[0], along, rise), tiles, taper=taper, edges=(NO_LINE, NO_LINE, low, high))


def pitched_roof(builder: SceneBuilder, lot: Lot, eaves: float, rng: np.random.Generator) -> None:
    """Add a gable roof with its ridge along or across the front, or a hipped one."""
    pitch = np.tan(np.radians(rng.uniform(28, 45)))
    width, depth, over = lot.width_m, lot.depth_m, rng.uniform(0.2, 0.45)
    plaster = Material(Semantic.BUILDING, 0.4)
    if rng.random() < 0.3:
        lot = Lot(lot.corner + depth * lot.inward, -lot.inward, lot.along, depth, width, lot.base_m)
        width, depth = depth, width
    top = eaves + 0.5 * depth * pitch
    low = eaves - over * pitch
    middle = 0.5 * depth
    hip = 0.0 if rng.random() < 0.7 else min(0.45 * width, 0.5 * depth)
    taper = 2 * hip / width
    ridge = (lot.point(hip, middle, top), lot.point(width - hip, middle, top))
    front = (lot.point(0.0, -over, low), lot.point(width, -over, low))
    back = (lot.point(width, depth + over, low), lot.point(0.0, depth + over, low))
    _slope(builder, front, ridge, taper)
    _slope(builder, back, (ridge[1], ridge[0]), taper)
    ends = [(lot.point(0.0, depth, eaves), lot.point(0.0, 0.0, eaves), hip)]
    ends.append((lot.point(width, 0.0, eaves), lot.point(width, depth, eaves), -hip))
    for left, right, lean in ends:
        rise = (top - eaves) * UP + lean * np.append(lot.along, 0.0)
        edges = [NO_LINE] * 4
        if hip == 0.0:
            apex = 0.5 * (np.asarray(left) + right) + rise
            for k, foot in enumerate((left, right)):
                edges[k] = builder.line(foot, apex, LineKind.OTHER_EDGE, Semantic.BUILDING)
        builder.patch((left, right - left, rise), plaster, taper=1.0, edges=edges)
    if rng.random() < 0.6:
        u = rng.uniform(0.2, 0.8) * width
        yaw = float(np.arctan2(lot.along[1], lot.along[0]))
        builder.box(lot.point(u, middle, top), yaw, (0.35, 0.35, 0.8), plaster)


def flat_roof(builder: SceneBuilder, lot: Lot, z: float, material: Material) -> None:
    """Add a flat roof just below the rim of the walls."""
    along, inward = lot.width_m * lot.along, lot.depth_m * lot.inward
    builder.patch((lot.point(0.0, 0.0, z), np.append(along, 0.0), np.append(inward, 0.0)), material)

"""One building: its outline with bays and recesses, walls, roof and what hangs on the front."""

from typing import NamedTuple

import numpy as np

from sl3d_slam.simulation.primitives import Material, SceneBuilder, Semantic, Windows
from sl3d_slam.simulation.roofs import flat_roof, pitched_roof
from sl3d_slam.simulation.walls import UP, Lot, walls


class Look(NamedTuple):
    """Height of the eaves (m), kind of roof, bays and recesses or a plain box, balconies."""

    eaves_m: float
    is_flat: bool
    is_structured: bool
    has_balconies: bool


def build(builder: SceneBuilder, lot: Lot, look: Look, rng: np.random.Generator) -> None:
    """Put up one building on a lot."""
    brick = Material(Semantic.BUILDING, rng.uniform(0.25, 0.6))
    width, depth = lot.width_m, lot.depth_m
    outline = [(0.0, 0.0), (width, 0.0), (width, depth), (0.0, depth)]
    if look.is_structured:
        outline = _outline(lot, rng)
    top = look.eaves_m + (0.6 if look.is_flat else 0.0)
    walls(builder, lot, outline, (top, brick, _windows(rng), look.is_flat))
    if look.is_flat:
        flat_roof(builder, lot, top - 0.4, brick)
    else:
        pitched_roof(builder, lot, look.eaves_m, rng)
    if look.has_balconies:
        _balconies(builder, lot, look.eaves_m, rng)
    elif look.is_structured:
        _front(builder, lot, rng)


def _windows(rng: np.random.Generator) -> Windows:
    pitch = rng.uniform(2.2, 3.6)
    width, height = pitch * rng.uniform(0.35, 0.6), rng.uniform(1.2, 1.8)
    return Windows(pitch, width, rng.uniform(2.7, 3.2), height, rng.uniform(0.1, 0.25))


def _outline(lot: Lot, rng: np.random.Generator) -> list[tuple[float, float]]:
    """Return the outline as (u, w), beginning front left, with bays and recesses in the front."""
    front: list[tuple[float, float]] = [(0.0, 0.0)]
    u = rng.uniform(0.8, 3.0)
    while u < lot.width_m - 4.0 and rng.random() < 0.75:
        width = rng.uniform(1.4, 3.2)
        step = rng.uniform(0.4, 1.5) * (1 if rng.random() < 0.6 else -0.6)
        front += [(u, 0.0), (u, step), (u + width, step), (u + width, 0.0)]
        u += width + rng.uniform(2.0, 6.0)
    front.append((lot.width_m, 0.0))
    back = [(lot.width_m, lot.depth_m), (0.0, lot.depth_m)]
    if rng.random() < 0.4:
        cut, inner = rng.uniform(0.3, 0.6) * lot.width_m, rng.uniform(0.6, 0.8) * lot.depth_m
        back = [(lot.width_m, inner), (cut, inner), (cut, lot.depth_m), (0.0, lot.depth_m)]
    return front + back


def _front(builder: SceneBuilder, lot: Lot, rng: np.random.Generator) -> None:
    """Hang awnings, shop signs and lanterns on a front, and steps before a door."""
    yaw = float(np.arctan2(lot.along[1], lot.along[0]))
    metal = Material(Semantic.BUILDING, 0.5)
    for u in np.arange(rng.uniform(1.0, 6.0), lot.width_m - 1.5, rng.uniform(2.5, 8.0)):
        reach, wide = rng.uniform(0.08, 0.5), rng.uniform(0.2, 1.2)
        high = rng.uniform(0.1, 0.4)
        builder.box(lot.point(u, -reach, rng.uniform(2.3, 3.2)), yaw, (wide, reach, high), metal)
    u = rng.uniform(1.0, max(1.5, lot.width_m - 1.5))
    builder.box(lot.point(u, -0.3, 0.1), yaw, (0.8, 0.45, 0.25), metal)


def _balconies(builder: SceneBuilder, lot: Lot, eaves: float, rng: np.random.Generator) -> None:
    """Add columns of balconies in front of a block."""
    slab = Material(Semantic.BUILDING, 0.4)
    rail = Material(Semantic.BUILDING, 0.35, 0.45)
    reach = rng.uniform(1.0, 1.5)
    for u in np.arange(rng.uniform(1.5, 4.0), lot.width_m - 4.0, rng.uniform(6.0, 9.0)):
        for z in np.arange(3.0, eaves - 2.5, 2.9):
            yaw = float(np.arctan2(lot.along[1], lot.along[0]))
            builder.box(lot.point(u + 1.5, -0.5 * reach, z), yaw, (1.5, 0.5 * reach, 0.09), slab)
            corner = lot.point(u, -reach, z)
            builder.patch((corner, 3.0 * np.append(lot.along, 0.0), 1.0 * UP), rail)

"""Buildings: footprints with bays and recesses, walls with windows, roofs, and their true edges."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from sl3d_slam.simulation.network import District, Street
from sl3d_slam.simulation.primitives import (
    NO_LINE,
    Material,
    SceneBuilder,
    Semantic,
    Vector,
    Windows,
)
from sl3d_slam.simulation.site import Site, beside, rectangle
from sl3d_slam.types import LineKind

UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, slots=True, eq=False)
class Lot:
    """The ground plan of a building: front left corner, along the front, inwards; metres."""

    corner: Float64[np.ndarray, "2"]
    along: Float64[np.ndarray, "2"]
    inward: Float64[np.ndarray, "2"]
    width_m: float
    depth_m: float
    base_m: float

    def point(self, u: float, w: float, z: float) -> Float64[np.ndarray, "3"]:
        """Return the town position of u along the front, w inwards and z above the base."""
        xy = self.corner + u * self.along + w * self.inward
        return np.array([xy[0], xy[1], self.base_m + z])


@dataclass(frozen=True, slots=True)
class Style:
    """How a district builds: ranges of widths, depths, setbacks, gaps and eaves, metres."""

    widths: tuple[float, float]
    depths: tuple[float, float]
    setbacks: tuple[float, float]
    gaps: tuple[float, float]
    eaves: tuple[float, float]
    flat_roofs: float
    empty: float


STYLES = {
    District.TERRACE: Style((7, 15), (9, 12), (2.3, 3.6), (0, 0), (6, 11), 0.12, 0.1),
    District.VILLAS: Style((9, 14), (8, 11), (5, 9), (4, 11), (3.2, 6.5), 0.1, 0.08),
    District.BLOCKS: Style((18, 34), (11, 14), (4.5, 9), (5, 14), (9, 16), 0.65, 0.1),
    District.WORKS: Style((22, 42), (14, 24), (6, 14), (6, 18), (5, 9), 0.85, 0.15),
    District.GREEN: Style((8, 12), (7, 9), (14, 24), (25, 60), (3, 5), 0.2, 0.75),
}


def build_street(site: Site, street: Street, rng: np.random.Generator) -> None:
    """Put buildings along both sides of a street, where there is room."""
    style = STYLES[street.district]
    for side in (-1, 1):
        setback = rng.uniform(*style.setbacks)
        at = rng.uniform(0, 6)
        while at < len(street.points) - 6:
            width = rng.uniform(*style.widths)
            if rng.random() < style.empty:
                at += rng.uniform(6, 14)
                continue
            if rng.random() < 0.5:
                setback = float(
                    np.clip(setback + rng.choice([-1, 1]) * rng.uniform(0.25, 1.2), *style.setbacks)
                )
            built = _try_lot(site, street, (side, at, width, setback), rng)
            at += (width if built else 2.5) + rng.uniform(*style.gaps) * built


def _try_lot(
    site: Site,
    street: Street,
    place: tuple[int, float, float, float],
    rng: np.random.Generator,
) -> bool:
    side, at, width, setback = place
    style = STYLES[street.district]
    ends = [beside(street, at, side, setback), beside(street, at + width, side, setback)]
    if side < 0:
        ends.reverse()
    chord = ends[0][:2] - ends[1][:2]
    length = float(np.linalg.norm(chord))
    if not 0.6 * width < length < 1.6 * width:
        return False
    along = chord / length
    inward = np.array([along[1], -along[0]])
    depth = rng.uniform(*style.depths)
    corner = ends[1][:2]
    inset = corner + 0.9 * along + 0.9 * inward
    covered = rectangle(inset, (length - 1.8) * along, (depth - 1.8) * inward)
    border = rectangle(corner - 0.6 * inward, length * along, (depth + 1.2) * inward)
    if not site.is_free(covered, 0.8) or (site.ground.road_distance_m(border) < 1.0).any():
        return False
    site.claim(rectangle(corner, length * along, depth * inward))
    base = float(site.ground.height_m(covered).min())
    build(site.builder, Lot(corner, along, inward, length, depth, base), style, rng)
    return True


def build(builder: SceneBuilder, lot: Lot, style: Style, rng: np.random.Generator) -> None:
    """Put up one building on a lot."""
    eaves = rng.uniform(*style.eaves)
    brick = Material(Semantic.BUILDING, rng.uniform(0.25, 0.6))
    outline = _outline(lot, rng)
    flat = rng.random() < style.flat_roofs
    top = eaves + (0.6 if flat else 0.0)
    walls(builder, lot, outline, (top, brick, _windows(rng), flat))
    if flat:
        _flat_roof(builder, lot, top - 0.4, brick)
    else:
        _pitched_roof(builder, lot, eaves, rng)
    if style.eaves[1] > 12 and rng.random() < 0.8:
        _balconies(builder, lot, eaves, rng)


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


def walls(
    builder: SceneBuilder,
    lot: Lot,
    outline: list[tuple[float, float]],
    look: tuple[float, Material, Windows, bool],
) -> None:
    """Put walls round an outline, each vertical edge a true line from the ground to the top."""
    top, material, windows, has_rim = look
    uprights = [
        builder.line(
            lot.point(u, w, 0.0), lot.point(u, w, top), LineKind.VERTICAL_EDGE, Semantic.BUILDING
        )
        for u, w in outline
    ]
    for k, (u, w) in enumerate(outline):
        nxt = (k + 1) % len(outline)
        start, end = lot.point(u, w, -0.6), lot.point(*outline[nxt], -0.6)
        length = float(np.linalg.norm(end - start))
        rim = NO_LINE
        if has_rim:
            rise = (top + 0.6) * UP
            rim = builder.line(start + rise, end + rise, LineKind.OTHER_EDGE, Semantic.BUILDING)
        glazed = windows if length > windows.pitch_u_m + 0.3 else None
        edges = (uprights[k], uprights[nxt], NO_LINE, rim)
        builder.patch((start, end - start, (top + 0.6) * UP), material, windows=glazed, edges=edges)


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


def _pitched_roof(builder: SceneBuilder, lot: Lot, eaves: float, rng: np.random.Generator) -> None:
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
    front = (lot.point(0, -over, low), lot.point(width, -over, low))
    back = (lot.point(width, depth + over, low), lot.point(0, depth + over, low))
    _slope(builder, front, ridge, taper)
    _slope(builder, back, (ridge[1], ridge[0]), taper)
    ends = [(lot.point(0, depth, eaves), lot.point(0, 0, eaves), hip)]
    ends.append((lot.point(width, 0, eaves), lot.point(width, depth, eaves), -hip))
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


def _flat_roof(builder: SceneBuilder, lot: Lot, z: float, material: Material) -> None:
    """Add a flat roof just below the rim of the walls."""
    along, inward = lot.width_m * lot.along, lot.depth_m * lot.inward
    builder.patch((lot.point(0, 0, z), np.append(along, 0.0), np.append(inward, 0.0)), material)


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

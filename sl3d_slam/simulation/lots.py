"""Which building stands where: a lot in every gap along a street, and some behind."""

from dataclasses import dataclass

import numpy as np

from sl3d_slam.simulation.buildings import Look, build
from sl3d_slam.simulation.network import District, Street
from sl3d_slam.simulation.site import Site, beside, rectangle
from sl3d_slam.simulation.walls import Lot


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
    District.TERRACE: Style(
        (7.0, 15.0), (9.0, 12.0), (2.3, 3.6), (0.0, 0.0), (6.0, 11.0), 0.12, 0.1
    ),
    District.VILLAS: Style(
        (9.0, 14.0), (8.0, 11.0), (5.0, 9.0), (4.0, 11.0), (3.2, 6.5), 0.1, 0.08
    ),
    District.BLOCKS: Style(
        (18.0, 34.0), (11.0, 14.0), (4.5, 9.0), (5.0, 14.0), (9.0, 16.0), 0.65, 0.1
    ),
    District.WORKS: Style(
        (18.0, 36.0), (10.0, 17.0), (6.0, 14.0), (6.0, 18.0), (5.0, 9.0), 0.85, 0.15
    ),
    District.GREEN: Style(
        (8.0, 12.0), (7.0, 9.0), (14.0, 24.0), (25.0, 60.0), (3.0, 5.0), 0.2, 0.75
    ),
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
    tall = style.eaves[1] > 12 and rng.random() < 0.8
    look = Look(rng.uniform(*style.eaves), bool(rng.random() < style.flat_roofs), True, tall)
    build(site.builder, Lot(corner, along, inward, length, depth, base), look, rng)
    return True


def build_backyards(site: Site, street: Street, rng: np.random.Generator) -> None:
    """Put sheds, garages and a second row of houses behind those along a street."""
    for at in np.cumsum(rng.exponential(9.0, 200)):
        if at > len(street.points):
            return
        side, offset = int(rng.choice([-1, 1])), rng.uniform(14, 48)
        place = beside(street, at, side, offset)
        yaw = place[2] + rng.choice([0.0, 0.5 * np.pi]) + rng.normal(0, 0.06)
        house = rng.random() < 0.4
        size = rng.uniform([8, 7], [15, 11]) if house else rng.uniform([2.5, 2.5], [7, 5])
        along = np.array([np.cos(yaw), np.sin(yaw)])
        inward = np.array([along[1], -along[0]])
        area = rectangle(place[:2], size[0] * along, size[1] * inward)
        if not site.is_free(area, 3.0):
            continue
        site.claim(area)
        base = float(site.ground.height_m(area).min())
        eaves = rng.uniform(3.5, 8.0) if house else rng.uniform(2.0, 3.0)
        look = Look(eaves, bool(rng.random() < 0.3), house, False)
        build(
            site.builder,
            Lot(place[:2], along, inward, float(size[0]), float(size[1]), base),
            look,
            rng,
        )

"""Trees, hedges and shrubs: foliage lets rays in, each by chance."""

import numpy as np

from sl3d_slam.simulation.furniture import pole
from sl3d_slam.simulation.ground import Positions
from sl3d_slam.simulation.network import District, Street
from sl3d_slam.simulation.primitives import Material, Semantic
from sl3d_slam.simulation.site import Site, beside, rectangle

BARK = Material(Semantic.TRUNK, 0.35)
STREET_TREES = {
    District.TERRACE: 34.0,
    District.VILLAS: 30.0,
    District.BLOCKS: 18.0,
    District.WORKS: 40.0,
    District.GREEN: 8.0,
}
SHRUBS = {
    District.TERRACE: 60.0,
    District.VILLAS: 8.0,
    District.BLOCKS: 12.0,
    District.WORKS: 16.0,
    District.GREEN: 2.2,
}


def leaves(rng: np.random.Generator) -> Material:
    """Return foliage that a ray enters by 0.3 to 0.8 m on average."""
    return Material(Semantic.VEGETATION, rng.uniform(0.3, 0.55), rng.uniform(1.2, 3.5))


def tree(site: Site, place: np.ndarray, margin_m: float, rng: np.random.Generator) -> None:
    """Plant a tree of some blobs of foliage where there is room."""
    radius = float(np.clip(rng.lognormal(-1.9, 0.4), 0.06, 0.35))
    height = site.place(place, max(0.5, 2 * radius), margin_m)
    if height is None:
        return
    foot = np.array([place[0], place[1], height])
    stem = rng.uniform(2.4, 3.8) if margin_m < 1.0 else rng.uniform(1.4, 3.0)
    top = pole(site.builder, foot, stem, radius, BARK)
    crown = rng.uniform(1.2, 2.8)
    material = leaves(rng)
    for _ in range(int(rng.integers(3, 7))):
        offset = rng.normal(0, 0.45, 3) * crown * np.array([1.0, 1.0, 0.8])
        radii = crown * rng.uniform(0.4, 0.8, 3)
        centre = top + offset + np.array([0.0, 0.0, 0.7 * crown])
        centre[2] = max(centre[2], top[2] - 0.2 + radii[2])
        site.builder.ellipsoid(centre, radii, material)


def shrub(site: Site, place: np.ndarray, margin_m: float, rng: np.random.Generator) -> None:
    """Plant a shrub of a few blobs."""
    height = site.place(place, 0.7, margin_m)
    if height is None:
        return
    material = leaves(rng)
    for _ in range(int(rng.integers(1, 4))):
        radii = rng.uniform([0.4, 0.4, 0.4], [1.1, 1.1, 1.3])
        x, y = place[:2] + rng.uniform(-0.3, 0.3, 2)
        site.builder.ellipsoid((x, y, height + 0.6 * radii[2]), radii, material)


def hedge(
    site: Site, street: Street, span: tuple[int, float, float], rng: np.random.Generator
) -> None:
    """Plant a hedge along ``span`` = side, start and length, bumpy on top."""
    side, at, length = span
    offset = rng.uniform(2.4, 3.2)
    start, end = beside(street, at, side, offset), beside(street, at + length, side, offset)
    run = end[:2] - start[:2]
    long = float(np.linalg.norm(run))
    if long < 1.0:
        return
    across = 0.8 * np.array([-run[1], run[0]]) / long
    area = rectangle(start[:2] - 0.5 * across, run, across)
    if not site.is_free(area, 0.8):
        return
    site.claim(area)
    half = 0.5 * rng.uniform(0.9, 2.0)
    centre = 0.5 * (start[:2] + end[:2])
    material = Material(Semantic.VEGETATION, rng.uniform(0.3, 0.5), rng.uniform(4.0, 9.0))
    z = site.height_m(centre)
    yaw = float(np.arctan2(run[1], run[0]))
    site.builder.box((*centre, z + half - 0.2), yaw, (0.5 * long, 0.4, half + 0.2), material)
    for s in np.arange(0.3, long, 0.9):
        x, y = start[:2] + run * s / long + rng.normal(0, 0.1, 2)
        radii = rng.uniform([0.45, 0.45, 0.3], [0.75, 0.75, 0.6])
        site.builder.ellipsoid((x, y, z + 2 * half - 0.1), radii, material)


def plant_street(site: Site, street: Street, rng: np.random.Generator) -> None:
    """Plant street trees, hedges and shrubs along both sides of a street."""
    green = street.district is District.GREEN
    for side in (-1, 1):
        spacing = STREET_TREES[street.district] * rng.uniform(0.6, 1.4)
        for at in np.arange(rng.uniform(0, spacing), len(street.points), spacing):
            offset = rng.uniform(1.2, 9.0) if green else rng.uniform(0.9, 1.6)
            tree(site, beside(street, at + rng.normal(0, 1.0), side, offset), 0.6, rng)
        if street.district in (District.VILLAS, District.BLOCKS, District.GREEN):
            for at in np.arange(rng.uniform(0, 10), len(street.points) - 8, rng.uniform(10, 22)):
                if rng.random() < 0.6:
                    hedge(site, street, (side, at, rng.uniform(4, 9)), rng)
        for at in np.cumsum(rng.exponential(SHRUBS[street.district], 200)):
            if at > len(street.points):
                break
            offset = 1.0 + rng.exponential(3.0 if green else 2.0)
            shrub(site, beside(street, at, side, offset), 0.9, rng)


def plant_backyards(site: Site, centres: Positions, rng: np.random.Generator) -> None:
    """Scatter trees and shrubs over what is left within 60 m of the given road positions."""
    for centre in centres[::2]:
        place = centre + rng.uniform(-60, 60, 2)
        if site.ground.road_distance_m(place[None])[0] < 4.0:
            continue
        if rng.random() < 0.6:
            tree(site, place, 4.0, rng)
        else:
            shrub(site, place, 4.0, rng)

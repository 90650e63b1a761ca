"""What stands at the roadside: lamp posts, signs, bollards, fences, cabinets and the like."""

import numpy as np

from sl3d_slam.simulation.network import District, Street
from sl3d_slam.simulation.primitives import Material, SceneBuilder, Semantic
from sl3d_slam.simulation.site import Site, beside
from sl3d_slam.types import LineKind

STEEL = Material(Semantic.POLE, 0.45)
PLATE = Material(Semantic.SIGN, 0.95)
CABINET = Material(Semantic.OTHER_OBJECT, 0.4)
UP = np.array([0.0, 0.0, 1.0])


def pole(
    builder: SceneBuilder, foot: np.ndarray, height: float, radius: float, material: Material
) -> np.ndarray:
    """Add an upright pole with its true line and return its top."""
    top = foot + height * UP
    line = builder.line(foot, top, LineKind.POLE, Semantic(int(material.semantic)))
    builder.cylinder(foot, top, radius, material, line)
    return top


def furnish(site: Site, street: Street, rng: np.random.Generator) -> None:
    """Put furniture along both sides of a street."""
    _lamps(site, street, rng)
    for side in (-1, 1):
        _signs(site, street, side, rng)
        _bollards(site, street, side, rng)
        _boxes(site, street, side, rng)
        if street.district in (District.VILLAS, District.WORKS):
            _fences(site, street, side, rng)


def _foot(site: Site, place: np.ndarray, radius: float, margin: float) -> np.ndarray | None:
    height = site.place(place, radius, margin)
    return None if height is None else np.array([place[0], place[1], height])


def _lamps(site: Site, street: Street, rng: np.random.Generator) -> None:
    """Add lamp posts: evenly spaced, one side or alternating, an arm over the road on most."""
    spacing, height = rng.uniform(19, 30), rng.uniform(4.5, 9)
    alternating, side = rng.random() < 0.4, int(rng.choice([-1, 1]))
    if street.district is District.GREEN and rng.random() < 0.6:
        return
    radius, reach = rng.uniform(0.06, 0.1), rng.uniform(0.0, 1.8)
    for count, at in enumerate(np.arange(rng.uniform(2, 12), len(street.points) - 1, spacing)):
        here = side * (-1) ** count if alternating else side
        place = beside(street, at + rng.normal(0, 0.4), here, rng.uniform(0.45, 0.7))
        foot = _foot(site, place, 0.2, 0.25)
        if foot is None:
            continue
        top = pole(site.builder, foot, height + rng.normal(0, 0.05), radius, STEEL)
        across = here * np.array([np.sin(place[2]), -np.cos(place[2]), 0.0])
        tip = top + reach * across + 0.15 * UP
        if reach > 0.6:
            site.builder.cylinder(top, tip, 0.04, Material(Semantic.POLE, 0.45))
        site.builder.box(tip, place[2] + np.pi / 2, (0.3, 0.12, 0.06), CABINET)


def _signs(site: Site, street: Street, side: int, rng: np.random.Generator) -> None:
    """Add traffic signs: a thin pole with one or two plates."""
    for at in np.cumsum(rng.exponential(26.0, 40)):
        if at > len(street.points):
            break
        place = beside(street, at, side, rng.uniform(0.35, 0.9))
        foot = _foot(site, place, 0.15, 0.25)
        if foot is None:
            continue
        top = pole(site.builder, foot, rng.uniform(2.2, 3.2), rng.uniform(0.03, 0.05), STEEL)
        yaw = place[2] + rng.normal(0, 0.25)
        across = np.array([-np.sin(yaw), np.cos(yaw), 0.0])
        back = 0.07 * np.array([np.cos(yaw), np.sin(yaw), 0.0]) * rng.choice([-1, 1])
        for k in range(int(rng.integers(1, 3))):
            w, h = rng.uniform(0.3, 0.6), rng.uniform(0.4, 0.7)
            corner = top - 0.5 * w * across - (h + 0.75 * k) * UP + back
            site.builder.patch((corner, w * across, h * UP), PLATE)


def _bollards(site: Site, street: Street, side: int, rng: np.random.Generator) -> None:
    """Add rows of bollards."""
    if street.district is District.GREEN:
        return
    for start in np.cumsum(rng.exponential(60.0, 10)):
        spacing, radius = rng.uniform(1.4, 2.5), rng.uniform(0.05, 0.1)
        for k in range(int(rng.integers(3, 9))):
            if start + k * spacing > len(street.points):
                return
            foot = _foot(site, beside(street, start + k * spacing, side, 0.35), 0.1, 0.2)
            if foot is not None:
                pole(site.builder, foot, rng.uniform(0.85, 1.0), radius, STEEL)


def _boxes(site: Site, street: Street, side: int, rng: np.random.Generator) -> None:
    """Add cabinets, bins, benches and advertising columns."""
    for at in np.cumsum(rng.exponential(17.0, 60)):
        if at > len(street.points):
            return
        place = beside(street, at, side, rng.uniform(0.6, 2.0))
        half = rng.uniform([0.2, 0.2, 0.3], [0.7, 0.4, 0.75])
        height = site.place(place, 0.6, 0.5)
        if height is not None:
            centre = np.array([place[0], place[1], height + half[2]])
            site.builder.box(centre, place[2] + rng.normal(0, 0.1), half, CABINET)


def _fences(site: Site, street: Street, side: int, rng: np.random.Generator) -> None:
    """Add garden fences: posts, rails, and wire that stops some of the rays."""
    at = rng.uniform(0, 20)
    while at < len(street.points) - 8:
        length, step, height = rng.uniform(8, 30), rng.uniform(1.8, 2.6), rng.uniform(0.9, 1.9)
        wire = Material(Semantic.FENCE, 0.35, rng.uniform(0.2, 0.65))
        previous = None
        for s in np.arange(at, min(at + length, len(street.points)), step):
            foot = _foot(site, beside(street, s, side, 2.6), 0.1, 0.4)
            if foot is not None:
                pole(site.builder, foot, height, 0.04, Material(Semantic.FENCE, 0.4))
                if previous is not None and np.linalg.norm(foot - previous) < 1.6 * step:
                    site.builder.patch((previous, foot - previous, height * UP), wire)
            previous = foot
        at += length + rng.uniform(3, 25)

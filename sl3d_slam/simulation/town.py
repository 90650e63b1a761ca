"""A town: everything that stands still, the same on every day."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from sl3d_slam.simulation.furniture import furnish
from sl3d_slam.simulation.ground import Ground, build_ground
from sl3d_slam.simulation.lots import build_backyards, build_street
from sl3d_slam.simulation.network import Network, build_network
from sl3d_slam.simulation.primitives import NO_LINE, Primitives, TrueLines
from sl3d_slam.simulation.roads import Road
from sl3d_slam.simulation.site import Site
from sl3d_slam.simulation.vegetation import plant_backyards, plant_street
from sl3d_slam.types import LineKind


@dataclass(frozen=True, slots=True, eq=False)
class Town:
    """A town in its own frame: x, y, z (up) of the lidar at scan 0 of day 0, metres."""

    road: Road
    seed: int
    ground: Ground
    network: Network
    primitives: Primitives
    lines: TrueLines


def build_town(road: Road, seed: int) -> Town:
    """Build the town along a road; it depends on the road and the seed only."""
    rng = np.random.default_rng([seed, 1])
    network = build_network(road, rng)
    ground = build_ground(network.samples, road.path[:, :3], rng)
    site = Site(ground)
    for street in network.streets:
        build_street(site, street, rng)
    for street in network.streets:
        build_backyards(site, street, rng)
        furnish(site, street, rng)
    for street in network.streets:
        plant_street(site, street, rng)
    plant_backyards(site, network.samples[:, :2], rng)
    primitives, lines = _without_flush_corners(site.builder.primitives(), site.builder.lines())
    return Town(road, seed, ground, network, primitives, lines)


def _without_flush_corners(
    primitives: Primitives, lines: TrueLines
) -> tuple[Primitives, TrueLines]:
    """Drop vertical edges where two houses meet in one plane: nobody sees an edge there."""
    upright = np.flatnonzero(lines.kinds == LineKind.VERTICAL_EDGE)
    pairs = cKDTree(lines.endpoints[upright, 0, :2]).query_pairs(0.2, output_type="ndarray")
    keep = np.ones(len(lines.kinds), bool)
    keep[upright[pairs.ravel()]] = False
    renumber = np.where(keep, np.cumsum(keep) - 1, NO_LINE)
    edges = np.where(primitives.edges >= 0, renumber[primitives.edges], NO_LINE)
    return (
        Primitives(primitives.kinds, primitives.parameters, primitives.materials, edges),
        TrueLines(lines.endpoints[keep], lines.kinds[keep], lines.semantics[keep]),
    )

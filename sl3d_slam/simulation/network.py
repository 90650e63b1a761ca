"""Streets to build along: the driven road without its repeats, side streets, districts."""

from dataclasses import dataclass
from enum import Enum

import numpy as np
from jaxtyping import Bool, Float64
from scipy.spatial import cKDTree

from sl3d_slam.simulation.roads import SPACING_M, Road, resample

SAME_ROAD_M = 8.0


class District(Enum):
    """The character of a stretch of street."""

    TERRACE = "terrace"
    VILLAS = "villas"
    BLOCKS = "blocks"
    WORKS = "works"
    GREEN = "green"


@dataclass(frozen=True, slots=True, eq=False)
class Street:
    """A stretch of road with one character: x, y, heading and half width every metre."""

    points: Float64[np.ndarray, "N 4"]
    district: District


@dataclass(frozen=True, slots=True, eq=False)
class Network:
    """All streets, and (N, 4) x, y, half width, pavement width all along every road."""

    streets: tuple[Street, ...]
    samples: Float64[np.ndarray, "N 4"]


def build_network(road: Road, rng: np.random.Generator) -> Network:
    """Split a road into streets with a district each and add side streets."""
    driven = resample(road.path[:, :2], SPACING_M)
    pieces = _without_repeats(driven)
    ways = [driven]
    streets = [s for piece in pieces for s in _districts(piece, rng)]
    for piece in pieces:
        for position in np.arange(rng.uniform(25, 60), len(piece) - 15, rng.uniform(60, 110)):
            side = _side_street(piece[int(position)], ways, rng)
            if side is not None:
                ways.append(side)
                streets.append(Street(with_width(side), _pick(rng)))
    samples = []
    characters = np.vstack([street.points[:, :2] for street in streets])
    of_street = np.repeat(np.arange(len(streets)), [len(s.points) for s in streets])
    for way in ways:
        nearest = of_street[cKDTree(characters).query(way[:, :2])[1]]
        green = np.array([streets[k].district is District.GREEN for k in nearest])
        wide = np.array([streets[k].district is District.BLOCKS for k in nearest])
        pavement = np.where(green, 0.0, np.where(wide, 3.0, 2.0))
        samples.append(np.column_stack([with_width(way)[:, [0, 1, 3]], pavement]))
    return Network(tuple(streets), np.vstack(samples))


def with_width(way: Float64[np.ndarray, "N 3"]) -> Float64[np.ndarray, "N 4"]:
    """Add the half width of the road, a smooth function of the place so that repeats agree."""
    x, y = way[:, 0], way[:, 1]
    wave = np.sin(x / 31.0 + 0.7) * np.cos(y / 27.0) + 0.5 * np.sin((x + y) / 13.0)
    return np.column_stack([way, 4.6 + 0.7 * wave])


def _without_repeats(way: Float64[np.ndarray, "N 3"]) -> list[Float64[np.ndarray, "K 3"]]:
    """Return the stretches of a way that are driven for the first time."""
    near = cKDTree(way[:, :2]).query_ball_point(way[:, :2], SAME_ROAD_M)
    fresh: Bool[np.ndarray, N] = np.ones(len(way), bool)
    for i, others in enumerate(near):
        earlier = np.array([j for j in others if j < i - 3 * SAME_ROAD_M], int)
        along = np.abs(np.cos(way[earlier, 2] - way[i, 2])) > 0.85
        fresh[i] = not along.any()
    edges = np.flatnonzero(np.diff(np.concatenate([[0], fresh.astype(int), [0]])))
    spans = zip(edges[::2], edges[1::2], strict=True)
    return [way[a:b] for a, b in spans if b - a >= 10]


def _pick(rng: np.random.Generator) -> District:
    built = [District.TERRACE, District.VILLAS, District.BLOCKS, District.WORKS]
    return built[rng.choice(4, p=[0.4, 0.32, 0.2, 0.08])]


def _districts(piece: Float64[np.ndarray, "K 3"], rng: np.random.Generator) -> list[Street]:
    """Cut a stretch into districts of 60 to 180 m; now and then one of them is green."""
    streets, begin, since_green = [], 0, 0
    while begin < len(piece):
        green = since_green >= 2 and rng.random() < 0.45
        length = int(rng.uniform(60, 150) if green else rng.uniform(70, 180))
        if len(piece) - begin - length < 40:
            length = len(piece) - begin
        points = with_width(piece[begin : begin + length])
        streets.append(Street(points, District.GREEN if green else _pick(rng)))
        since_green = 0 if green else since_green + 1
        begin += length
    return streets


def _side_street(
    start: Float64[np.ndarray, "3"], ways: list[np.ndarray], rng: np.random.Generator
) -> Float64[np.ndarray, "K 3"] | None:
    """Try a side street off one place of a road; None where another road is in the way."""
    heading = start[2] + rng.choice([-1, 1]) * rng.uniform(1.3, 1.8)
    s = np.arange(0.0, rng.uniform(45, 80), SPACING_M)
    bend = heading + rng.normal(0, 0.25) * (s / s[-1]) ** 2
    xy = start[:2] + SPACING_M * np.cumsum(np.column_stack([np.cos(bend), np.sin(bend)]), axis=0)
    away = cKDTree(np.vstack([way[:, :2] for way in ways])).query(xy)[0]
    blocked = np.flatnonzero((away < 22.0) & (s > 25.0))
    count = len(s) if len(blocked) == 0 else int(blocked[0])
    return np.column_stack([xy, bend])[:count] if count >= 30 else None

"""What changes from day to day: parked cars, traffic and people."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.spatial import cKDTree

from sl3d_slam.simulation.ground import Ground
from sl3d_slam.simulation.network import District, Network
from sl3d_slam.simulation.primitives import Material, Primitives, SceneBuilder, Semantic

UP = np.array([0.0, 0.0, 1.0])
PARKING = {
    District.TERRACE: 0.7,
    District.VILLAS: 0.35,
    District.BLOCKS: 0.6,
    District.WORKS: 0.3,
    District.GREEN: 0.1,
}


@dataclass(frozen=True, slots=True, eq=False)
class Traffic:
    """The traffic of one day.

    Attributes
    ----------
    parked : cars that stand all day.
    way : (K, 3) x, y, heading of the road that moving things follow.
    movers : (M, 6) start along the way (m), speed (m a scan, negative against the way), lateral
        offset (m, left positive), car 1 or person 0, size seed, reflectivity.
    """

    parked: Primitives
    way: Float64[np.ndarray, "K 3"]
    movers: Float64[np.ndarray, "M 6"]


def build_traffic(
    ground: Ground,
    network: Network,
    way: Float64[np.ndarray, "K 3"],
    path: Float64[np.ndarray, "N 2"],
    rng: np.random.Generator,
) -> Traffic:
    """Fill the streets for a day; nothing parks within 2.2 m of the driven path."""
    builder = SceneBuilder()
    driven = cKDTree(path)
    for street in network.streets:
        for side in (-1, 1):
            at = rng.uniform(0, 8)
            while at < len(street.points) - 6:
                if rng.random() < PARKING[street.district]:
                    row = street.points[int(at)]
                    away = side * (row[3] - 1.05)
                    place = row[:2] + away * np.array([-np.sin(row[2]), np.cos(row[2])])
                    inside = ground.road_distance_m(place[None])[0] > -1.6
                    if inside and driven.query(place)[0] > 2.2:
                        car(
                            builder,
                            ground,
                            (*place, row[2] + rng.normal(0, 0.03)),
                            (rng.random(), rng.random()),
                            Semantic.CAR,
                        )
                at += rng.uniform(5.2, 7.5)
    count = max(4, len(way) // 12)
    person = rng.random(count) < 0.5
    lateral = np.where(person, rng.choice([-1, 1], count) * rng.uniform(5.6, 7.0, count), 1.7)
    speed = np.where(person, rng.uniform(-0.14, 0.14, count), -rng.uniform(0.5, 1.1, count))
    movers = np.column_stack(
        [
            rng.uniform(0, len(way), count),
            speed,
            lateral,
            ~person,
            rng.random(count),
            rng.random(count),
        ]
    )
    return Traffic(builder.primitives(), way, movers)


def moving_primitives(
    traffic: Traffic, ground: Ground, scan_index: int, sensor_xy: Float64[np.ndarray, "2"]
) -> Primitives:
    """Return what moves within 75 m at the time of a scan, except what the car would touch."""
    builder = SceneBuilder()
    start, speed, lateral, cars = traffic.movers[:, :4].T
    along = (start + speed * scan_index) % len(traffic.way)
    rows = traffic.way[along.astype(int)]
    ahead = np.column_stack([np.cos(rows[:, 2]), np.sin(rows[:, 2])])
    left = np.column_stack([-ahead[:, 1], ahead[:, 0]])
    places = rows[:, :2] + (along % 1.0)[:, None] * ahead + lateral[:, None] * left
    away = np.linalg.norm(places - sensor_xy, axis=1)
    for k in np.flatnonzero((away < 75.0) & (away > np.where(cars, 3.6, 1.5))):
        size, shine = traffic.movers[k, 4:]
        if cars[k]:
            yaw = rows[k, 2] + (np.pi if speed[k] < 0 else 0.0)
            car(builder, ground, (*places[k], yaw), (size, shine), Semantic.MOVING_CAR)
        else:
            person(builder, ground, places[k], (size, scan_index))
    return builder.primitives()


def car(
    builder: SceneBuilder,
    ground: Ground,
    pose: tuple[float, float, float],
    look: tuple[float, float],
    semantic: Semantic,
) -> None:
    """Add a car or, one time in seven, a van: a body and a cabin with slanting windows."""
    size, shine = look
    paint = Material(semantic, 0.08 + 0.6 * shine)
    glass = Material(semantic, 0.08)
    place, yaw = np.array(pose[:2]), pose[2]
    forward = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    left = np.array([-forward[1], forward[0], 0.0])
    base = np.append(place, float(ground.height_m(place[None])[0]))
    long, wide = 1.9 + 0.5 * size, 0.82 + 0.08 * shine
    if size > 0.86:
        builder.box(base + 1.15 * UP, yaw, (2.5, 0.97, 0.9), paint)
        return
    shoulder, roof = 0.85 + 0.1 * shine, 1.42 + 0.15 * size
    builder.box(base + (0.5 * shoulder + 0.12) * UP, yaw, (long, wide, 0.5 * shoulder - 0.1), paint)
    feet = [(-0.85, -0.94), (0.45, -0.94), (0.45, 0.94), (-0.85, 0.94)]
    tops = [(-0.6, -0.72), (0.12, -0.72), (0.12, 0.72), (-0.6, 0.72)]
    low = [base + long * a * forward + wide * b * left + shoulder * UP for a, b in feet]
    high = [base + long * a * forward + wide * b * left + roof * UP for a, b in tops]
    for k in range(4):
        along = low[(k + 1) % 4] - low[k]
        shrink = 1.0 - np.linalg.norm(high[(k + 1) % 4] - high[k]) / np.linalg.norm(along)
        rise = 0.5 * (high[k] + high[(k + 1) % 4] - low[k] - low[(k + 1) % 4])
        rise -= (rise @ along) * along / (along @ along)
        builder.patch((low[k], along, rise), glass, taper=float(shrink))
    builder.patch((high[0], high[1] - high[0], high[3] - high[0]), paint)


def person(
    builder: SceneBuilder,
    ground: Ground,
    place: Float64[np.ndarray, "2"],
    look: tuple[float, int],
) -> None:
    """Add somebody walking: two legs, a body and a head."""
    size, step = look
    cloth = Material(Semantic.MOVING_PERSON, 0.2 + 0.3 * size)
    base = np.append(place, float(ground.height_m(place[None])[0]))
    height = 1.55 + 0.3 * size
    swing = 0.18 * np.sin(1.3 * step + 6.0 * size)
    for sign in (-1, 1):
        foot = base + np.array([sign * swing, 0.09 * sign, 0.0])
        builder.cylinder(foot, base + 0.5 * height * UP, 0.08, cloth)
    builder.ellipsoid(base + 0.66 * height * UP, (0.2, 0.24, 0.21 * height), cloth)
    builder.ellipsoid(base + 0.93 * height * UP, (0.1, 0.1, 0.13), cloth)

"""A drive through a town: where the sensor is at each scan, and the scans one by one."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float64

from sl3d_slam.geometry.se3 import Transform, make_transform
from sl3d_slam.simulation.ground import SENSOR_HEIGHT_M, Ground
from sl3d_slam.simulation.roads import resample
from sl3d_slam.simulation.scene import SimulatedScan, build_scene, cast_scan
from sl3d_slam.simulation.sensor import Sensor, sensor_named
from sl3d_slam.simulation.town import Town
from sl3d_slam.simulation.traffic import Traffic, build_traffic, moving_primitives

Direction = Literal["forward", "reverse", "half"]
DIRECTIONS: tuple[Direction, ...] = ("forward", "reverse", "half")
LANE_M = 1.8
TURN_SCANS = 30
BRAKING_M = 8.0
AXLE_M, TRACK_M = 1.35, 0.8


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """One drive through a town; ``T_town_lidar`` (N, 4, 4) holds the true poses."""

    town: Town
    day: int
    direction: Direction
    sensor: Sensor
    T_town_lidar: Float64[np.ndarray, "N 4 4"]
    traffic: Traffic

    def __len__(self) -> int:
        """Return the number of scans."""
        return len(self.T_town_lidar)


def plan_drive(
    town: Town,
    sensor: str = "hdl64",
    day: int = 0,
    direction: Direction = "forward",
    scans: int | None = None,
) -> Drive:
    """Plan a drive through a town.

    Parameters
    ----------
    sensor : one of ``SENSOR_NAMES``.
    day : other days have other traffic and another place in the lane.
    direction : ``forward``, ``reverse`` (the same road from its end), or ``half``: forward to the
        middle of the road, a U-turn, and back to the start in the other lane.
    scans : at most so many.
    """
    rng = np.random.default_rng([town.seed, 2, day])
    path = drive_path(town.road.path, town.road.returns, day, direction)
    path = path[: len(path) if scans is None else scans]
    poses = _poses(town.ground, path, rng if day else None)
    way = resample(town.road.path[:, :2], 1.0)
    traffic = build_traffic(town.ground, town.network, way, path[:, :2], rng)
    return Drive(town, day, direction, sensor_named(sensor), poses, traffic)


def simulate_drive(drive: Drive, indices: Iterable[int] | None = None) -> Iterator[SimulatedScan]:
    """Yield the scans of a drive in order, or those chosen; nothing is kept."""
    scene = build_scene(drive.town.ground, [drive.town.primitives, drive.traffic.parked])
    for index in range(len(drive)) if indices is None else indices:
        T_town_lidar = drive.T_town_lidar[index]
        place = T_town_lidar[:2, 3]
        scene.move(moving_primitives(drive.traffic, drive.town.ground, index, place))
        seed = drive.town.seed * 1009 + drive.day
        yield cast_scan(scene, T_town_lidar, drive.sensor, index, seed)


def drive_path(
    path: Float64[np.ndarray, "N 4"], returns: bool, day: int, direction: Direction
) -> Float64[np.ndarray, "K 3"]:
    """Return x, y, yaw of each scan of a drive along the day-0 path of a road."""
    out = path[:, [0, 1, 3]]
    aside = 0.0 if day == 0 else float(np.random.default_rng([day, 3]).uniform(-0.9, 0.9))
    if direction == "reverse":
        return _shift(_turned_round(out), -0.5 * LANE_M + aside)
    if direction == "half":
        return _with_u_turn(_shift(out[: len(out) // 2], aside))
    moved = _shift(out, aside)
    return _with_u_turn(moved) if returns else moved


def _turned_round(path: Float64[np.ndarray, "N 3"]) -> Float64[np.ndarray, "N 3"]:
    """Return the path driven from its end."""
    result = path[::-1].copy()
    result[:, 2] += np.pi
    return result


def _shift(
    path: Float64[np.ndarray, "N 3"], left_m: float | Float64[np.ndarray, "N"]
) -> Float64[np.ndarray, "N 3"]:
    """Move a path to its left."""
    x = path[:, 0] - left_m * np.sin(path[:, 2])
    y = path[:, 1] + left_m * np.cos(path[:, 2])
    return np.column_stack([x, y, path[:, 2]])


def _with_u_turn(centre: Float64[np.ndarray, "N 3"]) -> Float64[np.ndarray, "K 3"]:
    """Move to the right lane, drive out, turn left in a half circle, come back in the other one."""
    step = np.concatenate([[0.0], np.linalg.norm(np.diff(centre[:, :2], axis=0), axis=1)])
    blend = np.clip(np.cumsum(step) / 20.0, 0.0, 1.0)
    aside = LANE_M * blend * blend * (3.0 - 2.0 * blend)
    centre, aside = _braked(centre), _braked(np.column_stack([centre, aside]))[:, 3]
    out, back = _shift(centre, -aside), _turned_round(_shift(centre, aside))
    part = np.linspace(0.0, 1.0, TURN_SCANS + 2)[1:-1]
    angle = np.pi * part * part * (3.0 - 2.0 * part)
    x, y, yaw = centre[-1]
    ring = np.array([x, y]) + LANE_M * np.column_stack([np.sin(yaw + angle), -np.cos(yaw + angle)])
    return np.vstack([out, np.column_stack([ring, yaw + angle]), back])


def _braked(path: Float64[np.ndarray, "N K"]) -> Float64[np.ndarray, "M K"]:
    """Slow down evenly over the last metres of a path; x and y are its first columns."""
    steps = np.linalg.norm(np.diff(path[:, :2], axis=0), axis=1)
    travelled = np.concatenate([[0.0], np.cumsum(steps)])
    begin = int(np.searchsorted(travelled, travelled[-1] - BRAKING_M))
    braking = float(travelled[-1] - travelled[begin])
    count = max(2, round(2.0 * braking / max(float(steps[begin - 1]), 0.1)))
    distance = travelled[-1] - braking * (1.0 - np.arange(count) / count) ** 2
    tail = [np.interp(distance, travelled, column) for column in path.T]
    return np.vstack([path[:begin], np.column_stack(tail)])


def _poses(
    ground: Ground, path: Float64[np.ndarray, "N 3"], rng: np.random.Generator | None
) -> Float64[np.ndarray, "N 4 4"]:
    """Stand the car on the ground, with a little sway of its springs after the first metres."""
    x, y, yaw = path.T
    ahead = np.column_stack([np.cos(yaw), np.sin(yaw)])
    left = np.column_stack([-ahead[:, 1], ahead[:, 0]])
    front, rear, port, starboard = (
        ground.height_m(path[:, :2] + offset)
        for offset in (AXLE_M * ahead, -AXLE_M * ahead, TRACK_M * left, -TRACK_M * left)
    )
    travelled = np.cumsum(np.concatenate([[0], np.hypot(np.diff(x), np.diff(y))]))
    phases = np.zeros(3) if rng is None else rng.uniform(0, 6, 3)
    ramp = np.clip(travelled / 5.0, 0.0, 1.0)
    pitch_up = np.arctan2(front - rear, 2 * AXLE_M) + ramp * 0.004 * np.sin(
        0.9 * travelled + phases[0]
    )
    roll_left = np.arctan2(port - starboard, 2 * TRACK_M)
    roll_left = roll_left + ramp * 0.003 * np.sin(1.3 * travelled + phases[1])
    z = 0.25 * (front + rear + port + starboard) + SENSOR_HEIGHT_M
    z = z + ramp * 0.012 * np.sin(1.7 * travelled + phases[2])
    return np.stack(
        [
            _pose(
                np.array([x[k], y[k], z[k]]), float(yaw[k]), float(pitch_up[k]), float(roll_left[k])
            )
            for k in range(len(path))
        ]
    )


def _pose(
    position: Float64[np.ndarray, "3"], yaw: float, pitch_up: float, roll_left: float
) -> Transform:
    """Return the pose with the given heading, nose up by ``pitch_up``, left side up by roll."""
    forward = np.array(
        [np.cos(yaw) * np.cos(pitch_up), np.sin(yaw) * np.cos(pitch_up), np.sin(pitch_up)]
    )
    level = np.array([-np.sin(yaw), np.cos(yaw), 0.0])
    up = np.cross(forward, level)
    left = np.cos(roll_left) * level + np.sin(roll_left) * up
    return make_transform(np.column_stack([forward, left, np.cross(forward, left)]), position)

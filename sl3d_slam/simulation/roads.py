"""Roads to build a town along: built-in ones, or any KITTI trajectory."""

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from sl3d_slam.errors import InputError
from sl3d_slam.geometry.se3 import Transform, invert

SPACING_M = 1.0
ROAD_NAMES = ("loop", "street", "outback", "demo")

# KITTI odometry 00's calibration: lidar (x fwd, y left, z up) to camera (x right, y down, z fwd).
TR_CAMERA_LIDAR: Transform = np.array(
    [
        [4.276802385584e-04, -9.999672484946e-01, -8.084491683471e-03, -1.198459927713e-02],
        [-7.210626507497e-03, 8.081198471645e-03, -9.999413164504e-01, -5.403984729748e-02],
        [9.999738645903e-01, 4.859485810390e-04, -7.206933692422e-03, -2.921968648686e-01],
        [0.0, 0.0, 0.0, 1.0],
    ]
)


@dataclass(frozen=True, slots=True, eq=False)
class Road:
    """The way a car drives on day 0, one row a scan, in the town frame.

    Attributes
    ----------
    name : built-in name, or the name of the trajectory file.
    path : (N, 4) x, y, z in metres and yaw in radians; the first row is zero. z is only a hint:
        where the road passes twice the town's ground is smoothed over both.
    returns : whether the car turns round at the end and drives back in the other lane.
    """

    name: str
    path: Float64[np.ndarray, "N 4"]
    returns: bool = False


def read_road(path: Path) -> Road:
    """Return the road of a KITTI pose file: 12 numbers a row, camera in the first camera frame.

    Raises
    ------
    InputError
        where the file cannot be read as such, or moves less than 20 m.
    """
    try:
        lines = path.read_text(encoding="utf-8").split("\n")
        rows = np.array([line.split() for line in lines if line.strip()], float)
    except OSError as error:
        raise InputError(f"{path}: cannot be read as a trajectory ({error.strerror})") from None
    except ValueError:
        rows = np.zeros((0, 0))
    if rows.ndim != 2 or rows.shape[1] != 12 or not np.isfinite(rows).all():
        raise InputError(f"{path}: expected a KITTI trajectory of 12 finite numbers a row")
    T_camera0_camera = np.tile(np.eye(4), (len(rows), 1, 1))
    T_camera0_camera[:, :3] = rows.reshape(-1, 3, 4)
    T_lidar0_lidar = invert(TR_CAMERA_LIDAR) @ T_camera0_camera @ TR_CAMERA_LIDAR
    T_lidar0_lidar = invert(T_lidar0_lidar[0]) @ T_lidar0_lidar
    yaw = np.arctan2(T_lidar0_lidar[:, 1, 0], T_lidar0_lidar[:, 0, 0])
    poses = np.column_stack([T_lidar0_lidar[:, :3, 3], np.unwrap(yaw)])
    if np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1).sum() < 20.0:
        raise InputError(
            f"{path}: the trajectory is shorter than 20 m, too short to build a town on"
        )
    return Road(path.name, poses)


def builtin_road(name: str) -> Road:
    """Return one of the built-in roads: ``loop``, ``street``, ``outback`` or ``demo``.

    ``loop`` closes on itself after about 500 m and goes on for 80 m; ``demo`` does the same within
    some 190 m; ``street`` is 260 m one way; ``outback`` drives 220 m of it, turns and comes back.

    Raises
    ------
    InputError
        for any other name.
    """
    match name:
        case "loop":
            corners = [(0, 0), (150, 8), (172, 66), (118, 118), (48, 96), (-32, 112), (-52, 30)]
            return Road(name, _drive(_closed(corners, 14.0, 80.0), 0.85))
        case "demo":
            corners = [(0, 0), (46, 0), (56, 36), (16, 52), (-14, 30)]
            return Road(name, _drive(_closed(corners, 9.0, 42.0), 1.0))
        case "street":
            return Road(name, _drive(_wave(260.0), 0.9))
        case "outback":
            return Road(name, _drive(_wave(220.0), 0.9), returns=True)
        case _:
            raise InputError(f"road {name!r}: expected one of {', '.join(ROAD_NAMES)}")


def _wave(length_m: float) -> Float64[np.ndarray, "K 2"]:
    """Return a street with two slight bends, in steps of 5 cm."""
    s = np.arange(0.0, length_m, 0.05)
    yaw = 0.35 * (1 - np.cos(2 * np.pi * s / 180.0)) * np.sign(np.sin(np.pi * s / 180.0))
    return 0.05 * np.cumsum(np.column_stack([np.cos(yaw), np.sin(yaw)]), axis=0)


def _closed(
    corners: list[tuple[int, int]], radius_m: float, overlap_m: float
) -> Float64[np.ndarray, "K 2"]:
    """Return a closed polygon with rounded corners, begun again for ``overlap_m``."""
    points = np.array(corners, float)
    start = 0.5 * (points[0] + points[1])
    ring = np.vstack([start, points[1:], points[0], start])
    dense = np.vstack([_straight(a, b) for a, b in pairwise(ring)])
    width = round(2 * radius_m / 0.05)
    padded = np.vstack([dense[-2 * width :], dense, dense[: 2 * width]])
    sums = np.cumsum(padded, axis=0)
    smooth = (sums[width:] - sums[:-width]) / width
    smooth = smooth[2 * width - width // 2 :][: len(dense)]
    return np.vstack([smooth, smooth[: round(overlap_m / 0.05)]])


def _straight(a: Float64[np.ndarray, "2"], b: Float64[np.ndarray, "2"]) -> np.ndarray:
    count = round(float(np.linalg.norm(b - a)) / 0.05)
    return a + (b - a) * np.arange(count)[:, None] / count


def _drive(points: Float64[np.ndarray, "K 2"], step_m: float) -> Float64[np.ndarray, "N 4"]:
    """Sample a way every ``step_m`` (10 % faster and slower at times), turned to start at zero."""
    travelled = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    count = int(travelled[-1] / step_m)
    s = step_m * (np.arange(count) + 1.5 * np.sin(np.arange(count) / 15.0))
    s = np.clip(s, 0.0, travelled[-1] - 0.5)
    xy = np.column_stack([np.interp(s, travelled, points[:, k]) for k in (0, 1)])
    ahead = np.column_stack([np.interp(s + 0.5, travelled, points[:, k]) for k in (0, 1)]) - xy
    yaw = np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))
    c, sine = np.cos(yaw[0]), np.sin(yaw[0])
    turned = (xy - xy[0]) @ np.array([[c, -sine], [sine, c]])
    return np.column_stack([turned, np.zeros(count), yaw - yaw[0]])


def resample(xy: Float64[np.ndarray, "N 2"], spacing_m: float) -> Float64[np.ndarray, "K 3"]:
    """Return x, y and heading every ``spacing_m`` along a polyline; standing still is skipped."""
    steps = np.linalg.norm(np.diff(xy, axis=0), axis=1)
    keep = np.concatenate([[True], steps > 1e-3])
    travelled = np.cumsum(np.concatenate([[0.0], steps]))[keep]
    s = np.arange(0.0, travelled[-1], spacing_m)
    x, y = (np.interp(s, travelled, xy[keep, k]) for k in (0, 1))
    heading = np.arctan2(np.gradient(y), np.gradient(x))
    return np.column_stack([x, y, heading])

"""From the raw returns of any file to the points of a scan: correction, range filter, times."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Shaped

from sl3d_slam.config import InputSettings
from sl3d_slam.errors import InputError
from sl3d_slam.geometry.se3 import Points
from sl3d_slam.types import Scan

MIN_POINTS = 100
KITTI_ELEVATION_OFFSET_DEG = 0.205
HDL64_ELEVATIONS_DEG = (-26.0, 7.0)  # KITTI's scans reach from -25.5 to 5.5
FOREIGN_SHARE = 0.01
TIME_FIELDS = (
    "t", "time", "times", "timestamp", "timestamps", "time_stamp", "offset_time", "time_offset",
    "stamp",
)  # fmt: skip
MAX_SWEEP_S = 2.0

Times = Float64[np.ndarray, "N"]


@dataclass(frozen=True, slots=True, eq=False)
class Cloud:
    """What a file or message holds, before any filter; it lives inside ``io`` only.

    Attributes
    ----------
    points : (N, 3) metres in the sensor frame, possibly with NaN.
    times : (N,) a time for each point in the file's own unit and type, or None.
    """

    points: Points
    times: Shaped[np.ndarray, "N"] | None = None


def cloud_from_fields(fields: np.ndarray, source: str) -> Cloud:
    """Pick ``x``, ``y``, ``z`` and a time field from a structured array; letter case is ignored.

    Raises
    ------
    InputError
        naming ``source`` where a coordinate is missing.
    """
    names = {name.lower(): name for name in fields.dtype.names or ()}
    if not {"x", "y", "z"} <= names.keys():
        raise InputError(f"{source}: has fields {sorted(names)}; expected x, y and z among them")
    points = np.column_stack([fields[names[axis]].astype(np.float64) for axis in "xyz"])
    time_field = find_time_field(tuple(names.values()))
    return Cloud(points, None if time_field is None else fields[time_field])


def raise_elevation(points: Points, angle_deg: float) -> Points:
    """Turn every point towards +z about its own horizontal axis; range and azimuth stay.

    KITTI's Velodyne HDL-64E reports elevations 0.205 deg too low (Deschaud, IMLS-SLAM, ICRA 2018;
    the figure is KISS-ICP's). Points on the z axis have no such axis and stay.
    """
    cosine, sine = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    horizontal = np.hypot(points[:, 0], points[:, 1])
    z = points[:, 2]
    on_axis = horizontal == 0.0
    turned = np.empty_like(points)
    with np.errstate(invalid="ignore"):  # infinite coordinates become NaN, and are left out later
        scale = (horizontal * cosine - z * sine) / np.where(on_axis, 1.0, horizontal)
        turned[:, :2] = points[:, :2] * scale[:, None]
        turned[:, 2] = z * cosine + horizontal * sine
    turned[on_axis] = points[on_axis]
    return turned


def looks_like_hdl64(points: Points) -> bool:
    """Tell whether nearly all points lie in the field of view of KITTI's Velodyne HDL-64E.

    Other sensors that people put into KITTI's layout (HDL-32E, OS1) have a quarter outside.
    """
    lowest, highest = np.tan(np.radians(HDL64_ELEVATIONS_DEG))
    with np.errstate(over="ignore", invalid="ignore"):
        horizontal = np.hypot(points[:, 0], points[:, 1])
        foreign = (points[:, 2] < lowest * horizontal) | (points[:, 2] > highest * horizontal)
    return bool(foreign.mean() < FOREIGN_SHARE)


def elevation_offset_deg(settings: InputSettings, is_kitti_hdl64: Callable[[], bool]) -> float:
    """Return the correction that the settings ask for, 0.205 or 0 deg.

    Only ``auto`` asks whether the scans are those of KITTI's own sensor.
    """
    wanted = settings.kitti_correction
    applies = wanted == "on" or (wanted == "auto" and is_kitti_hdl64())
    return KITTI_ELEVATION_OFFSET_DEG if applies else 0.0


def corrected(cloud: Cloud, elevation_offset_deg: float) -> Cloud:
    """Return a cloud with :func:`raise_elevation` applied; 0 leaves it untouched."""
    if elevation_offset_deg == 0.0:
        return cloud
    return Cloud(raise_elevation(cloud.points, elevation_offset_deg), cloud.times)


def make_scan(
    position: tuple[int, float], cloud: Cloud, settings: InputSettings, source: str
) -> Scan:
    """Keep finite points within the range limits; ``position`` is (index, stamp in seconds).

    Raises
    ------
    InputError
        naming ``source`` where fewer than 100 points are left.
    """
    keep = usable(cloud.points, settings, source)
    times_s = None if cloud.times is None else to_sweep_seconds(cloud.times[keep])
    points = cloud.points.compress(keep, axis=0)  # a fifth of the time that [keep] takes
    return Scan(position[0], position[1], points, times_s)


def checked_points(points_lidar: np.ndarray, source: str) -> Points:
    """Return a caller's points as float64, or raise InputError where they are no (N, 3)."""
    points = np.asarray(points_lidar, np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"{source}: points have shape {points.shape}, expected (N, 3) in metres")
    return points


def usable(points: Points, settings: InputSettings, source: str) -> np.ndarray:
    """Return the mask of finite points within the range limits, or raise InputError."""
    with np.errstate(over="ignore", invalid="ignore"):
        squared = np.einsum("ij,ij->i", points, points)
        keep = (squared >= settings.min_range_m**2) & (squared <= settings.max_range_m**2)
    count = int(np.count_nonzero(keep))
    if count < MIN_POINTS:
        raise InputError(
            f"{source}: {count} of {len(points)} points are finite and between "
            f"{settings.min_range_m:g} m and {settings.max_range_m:g} m; "
            f"expected at least {MIN_POINTS}"
        )
    return keep


def find_time_field(names: Sequence[str]) -> str | None:
    """Return the field that holds a time for each point, by its usual names, or None."""
    lowered = {name.lower(): name for name in names}
    return next((lowered[name] for name in TIME_FIELDS if name in lowered), None)


def to_sweep_seconds(raw: np.ndarray) -> Times | None:
    """Convert point times of unknown unit to seconds from the first point of the sweep.

    A sweep lasts 0.02 to 2 s, so the span tells the unit: seconds, milli-, micro- or nanoseconds.
    None where the times are not finite, do not differ, or fit no unit. Integer times lose no
    digits, as the first is subtracted before anything becomes a float.
    """
    if len(raw) == 0 or not np.isfinite(raw).all():
        return None
    relative = (raw - raw.min()).astype(np.float64)
    span = float(relative.max())
    for factor in (1.0, 1e-3, 1e-6, 1e-9):
        if MAX_SWEEP_S / 1000.0 < span * factor <= MAX_SWEEP_S:
            return relative * factor
    return None

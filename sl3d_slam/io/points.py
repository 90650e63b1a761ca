"""From the raw returns of any file to the points of a scan: correction, range filter, times."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from sl3d_slam.config import InputSettings
from sl3d_slam.errors import InputError
from sl3d_slam.geometry.se3 import Points
from sl3d_slam.types import Scan

MIN_POINTS = 100
KITTI_ELEVATION_OFFSET_DEG = 0.205
TIME_FIELDS = (
    "t", "time", "times", "timestamp", "timestamps", "time_stamp", "offset_time", "time_offset",
    "stamp",
)  # fmt: skip
MAX_SWEEP_S = 2.0

Times = Float64[np.ndarray, "N"]


def raise_elevation(points: Points, angle_deg: float) -> Points:
    """Turn every point towards +z about its own horizontal axis; range and azimuth stay.

    KITTI's Velodyne HDL-64E reports elevations 0.205 deg too low (Deschaud, IMLS-SLAM, ICRA 2018;
    the figure is KISS-ICP's). Points on the z axis have no such axis and stay.
    """
    cosine, sine = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    horizontal = np.hypot(points[:, 0], points[:, 1])
    z = points[:, 2]
    on_axis = horizontal == 0.0
    scale = (horizontal * cosine - z * sine) / np.where(on_axis, 1.0, horizontal)
    turned = np.empty_like(points)
    turned[:, :2] = points[:, :2] * scale[:, None]
    turned[:, 2] = z * cosine + horizontal * sine
    turned[on_axis] = points[on_axis]
    return turned


def make_scan(
    position: tuple[int, float], points: Points, times_s: Times | None, settings: InputSettings,
    source: str,
) -> Scan:  # fmt: skip
    """Keep finite points within the range limits; ``position`` is (index, stamp in seconds).

    Raises
    ------
    InputError
        naming ``source`` where fewer than 100 points are left.
    """
    keep = usable(points, settings, source)
    index, stamp_s = position
    kept_times = None if times_s is None else times_s[keep]
    if kept_times is not None and not np.isfinite(kept_times).all():
        raise InputError(f"{source}: its point times are not all finite numbers")
    return Scan(index, stamp_s, points[keep], kept_times)


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

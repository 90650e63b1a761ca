"""GPS and attitude of other sensors from text files, in the clock of the scans.

GPS is TUM (``stamp x y z qx qy qz qw``; metres in a frame of its own, the rotation is not used) or
CSV with a first line that names its columns: ``t,lat,lon,alt`` (seconds, degrees, metres above the
ellipsoid) and, if known, ``sigma_e,sigma_n,sigma_u`` (or one ``sigma``, metres).

Attitude is CSV: ``t,up_x,up_y,up_z`` (which way is up in the lidar frame, of any length: an
accelerometer at rest) or ``t,qx,qy,qz,qw`` (the lidar in a level world), and, if known,
``sigma_deg``.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from sl3d_slam.config import WorldSettings
from sl3d_slam.errors import InputError
from sl3d_slam.geometry.geodesy import GeoOrigin, enu_from_geodetic
from sl3d_slam.io.text_table import read_text
from sl3d_slam.io.trajectory import read_tum
from sl3d_slam.types import PositionFixes, UpFixes, WorldMeasurements

Columns = dict[str, Float64[np.ndarray, "N"]]
GPS_EXPECTED = "TUM rows, or CSV with a first line 't,lat,lon,alt[,sigma_e,sigma_n,sigma_u]'"
ATTITUDE_EXPECTED = (
    "CSV with a first line 't,up_x,up_y,up_z[,sigma_deg]' or 't,qx,qy,qz,qw[,sigma_deg]'"
)


def read_world(
    gps: Path | None, attitude: Path | None, settings: WorldSettings
) -> WorldMeasurements:
    """Read what is given. Raises InputError, naming the file and what was expected."""
    return WorldMeasurements(
        None if gps is None else read_gps(gps, settings),
        None if attitude is None else read_attitude(attitude, settings),
    )


def read_gps(path: Path, settings: WorldSettings) -> PositionFixes:
    """Read positions; the origin of CSV is its first fix. Raises InputError."""
    if "," not in _first_line(path, GPS_EXPECTED):
        given = read_tum(path)
        _require_order(path, given.stamps_s)
        positions = np.ascontiguousarray(given.T_world_lidar[:, :3, 3])
        sigmas = np.full_like(positions, settings.position_sigma_m)
        return PositionFixes(given.stamps_s, positions, sigmas)
    table = _read_csv(path, GPS_EXPECTED)
    t, lat, lon, alt = _take(path, table, ("t", "lat", "lon", "alt"), GPS_EXPECTED)
    if np.abs(lat).max() > 90.0 or np.abs(lon).max() > 360.0:
        raise InputError(f"{path}: a latitude or longitude is out of range; expected degrees")
    _require_order(path, t)
    origin = GeoOrigin(float(lat[0]), float(lon[0]), float(alt[0]))
    sigmas = _sigmas(path, table, settings)
    return PositionFixes(t, enu_from_geodetic(lat, lon, alt, origin), sigmas, origin)


def read_attitude(path: Path, settings: WorldSettings) -> UpFixes:
    """Read which way is up. Raises InputError."""
    table = _read_csv(path, ATTITUDE_EXPECTED)
    if "qx" in table:
        t, *quat = _take(path, table, ("t", "qx", "qy", "qz", "qw"), ATTITUDE_EXPECTED)
        quat_xyzw = np.column_stack(quat)
        if np.any(np.abs(np.linalg.norm(quat_xyzw, axis=1) - 1.0) > 0.01):
            raise InputError(f"{path}: a quaternion qx qy qz qw is not of unit length")
        up = np.ascontiguousarray(Rotation.from_quat(quat_xyzw).as_matrix()[:, 2, :])
    else:
        t, *parts = _take(path, table, ("t", "up_x", "up_y", "up_z"), ATTITUDE_EXPECTED)
        up = np.column_stack(parts)
        lengths = np.linalg.norm(up, axis=1, keepdims=True)
        if np.any(lengths < 1e-6):
            raise InputError(f"{path}: an up direction has no length; {ATTITUDE_EXPECTED}")
        up = up / lengths
    _require_order(path, t)
    sigmas = np.radians(table.get("sigma_deg", np.full(len(t), settings.attitude_sigma_deg)))
    _require_positive(path, sigmas)
    return UpFixes(t, up, sigmas)


def _first_line(path: Path, expected: str) -> str:
    for line in read_text(path, expected).splitlines():
        if line.strip() and not line.startswith("#"):
            return line
    raise InputError(f"{path}: is empty; expected {expected}")


def _read_csv(path: Path, expected: str) -> Columns:
    """Return the columns of a CSV file by the lower-case names of its first line."""
    lines = [
        (number, line.split(","))
        for number, line in enumerate(read_text(path, expected).splitlines(), start=1)
        if line.strip() and not line.startswith("#")
    ]
    names = [name.strip().lower() for name in lines[0][1]] if lines else []
    if len(lines) < 2 or len(set(names)) != len(names) or "t" not in names:
        raise InputError(f"{path}: has no named columns with rows below; expected {expected}")
    rows = [_row(path, number, words, len(names)) for number, words in lines[1:]]
    table = np.array(rows, dtype=np.float64)
    return {name: np.ascontiguousarray(table[:, k]) for k, name in enumerate(names)}


def _row(path: Path, number: int, words: list[str], count: int) -> list[float]:
    try:
        row = [float(word) for word in words]
    except ValueError:
        row = []
    if len(row) != count or not np.isfinite(row).all():
        raise InputError(f"{path}: line {number} is not {count} finite numbers, as its first line")
    return row


def _take(
    path: Path, table: Columns, names: tuple[str, ...], expected: str
) -> list[Float64[np.ndarray, "N"]]:
    missing = [name for name in names if name not in table]
    if missing:
        raise InputError(f"{path}: has no column {missing[0]!r}; expected {expected}")
    return [table[name] for name in names]


def _sigmas(path: Path, table: Columns, settings: WorldSettings) -> Float64[np.ndarray, "N 3"]:
    usual = np.full(len(table["t"]), settings.position_sigma_m)
    one = table.get("sigma", usual)
    sigmas = np.column_stack([table.get(f"sigma_{axis}", one) for axis in "enu"])
    _require_positive(path, sigmas)
    return sigmas


def _require_positive(path: Path, sigmas: np.ndarray) -> None:
    if np.any(sigmas <= 0.0):
        raise InputError(f"{path}: a sigma is not above zero; expected standard deviations")


def _require_order(path: Path, stamps_s: np.ndarray) -> None:
    if np.any(np.diff(stamps_s) < 0.0):
        row = int(np.argmax(np.diff(stamps_s) < 0.0)) + 2
        raise InputError(f"{path}: the time goes back at row {row}; expected seconds in order")

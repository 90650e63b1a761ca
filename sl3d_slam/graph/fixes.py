"""Fixes of other sensors as factors on the scan that was taken last before them.

A fix between two scans is moved onto the earlier one along the odometry: for a position the
antenna's lever arm, for an up direction the vector itself is expressed in that scan's frame.
"""

from dataclasses import dataclass

import gtsam
import numpy as np
from jaxtyping import Bool, Float64
from scipy.stats import chi2

from sl3d_slam.config import WorldSettings
from sl3d_slam.errors import GraphError
from sl3d_slam.geometry.se3 import Points, Transform, interpolate, invert, transform_points
from sl3d_slam.graph.batched import Transforms
from sl3d_slam.types import PositionFixes, Trajectory, UpFixes, WorldMeasurements

CLOCK_TOLERANCE_S = 1e-3
HUBER_SIGMAS = 1.345
UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, slots=True, eq=False)
class Fix:
    """One factor on one scan; ``threshold`` bounds the squared residual of an honest fix."""

    scan: int
    honest: gtsam.NonlinearFactor
    cautious: gtsam.NonlinearFactor
    threshold: float


@dataclass(frozen=True, slots=True, eq=False)
class AttachedPositions:
    """Positions with the scan they belong to; ``antennas`` (N, 3) in those scans' frames."""

    scans: np.ndarray
    antennas: Points
    positions: Points
    sigmas_m: Float64[np.ndarray, "N 3"]


def attach_positions(
    fixes: PositionFixes, odometry: Trajectory, settings: WorldSettings
) -> AttachedPositions:
    """Keep the fixes within the drive, each on its scan. Raises GraphError where none is."""
    inside, scans, motions = _place(fixes.stamps_s, odometry, "GPS fixes")
    lever = np.array([[settings.antenna_x_m, settings.antenna_y_m, settings.antenna_z_m]])
    antennas = np.array([transform_points(T_scan_fix, lever)[0] for T_scan_fix in motions])
    return AttachedPositions(scans, antennas, fixes.positions_enu[inside], fixes.sigmas_m[inside])


def position_fixes(attached: AttachedPositions, settings: WorldSettings) -> list[Fix]:
    """Return the positions as factors on poses ``T_enu_lidar``."""
    threshold = float(chi2.ppf(settings.kept_probability, 3))
    rows = zip(
        attached.scans.tolist(),
        attached.positions,
        attached.antennas,
        attached.sigmas_m,
        strict=True,
    )
    fixes = []
    for scan, position, antenna, sigmas_m in rows:
        noise = gtsam.noiseModel.Diagonal.Sigmas(sigmas_m)
        honest, cautious = (
            gtsam.GPSFactorArm(scan, position, antenna, model) for model in (noise, _huber(noise))
        )
        fixes.append(Fix(scan, honest, cautious, threshold))
    return fixes


def up_fixes(ups: UpFixes, odometry: Trajectory, settings: WorldSettings) -> list[Fix]:
    """Return the up directions within the drive as factors on poses in a level world."""
    inside, scans, motions = _place(ups.stamps_s, odometry, "attitudes")
    threshold = float(chi2.ppf(settings.kept_probability, 2))
    fixes = []
    for row, scan, T_scan_fix in zip(np.flatnonzero(inside), scans.tolist(), motions, strict=True):
        noise = gtsam.noiseModel.Isotropic.Sigma(2, float(ups.sigmas_rad[row]))
        up_scan = gtsam.Unit3(T_scan_fix[:3, :3] @ ups.up_lidar[row])
        honest, cautious = (
            gtsam.AttitudeFactorPose3(scan, gtsam.Unit3(UP), model, up_scan)
            for model in (noise, _huber(noise))
        )
        fixes.append(Fix(scan, honest, cautious, threshold))
    return fixes


def require_overlap(measurements: WorldMeasurements, stamps_s: np.ndarray) -> None:
    """Check that something was measured during the drive; raises GraphError."""
    for fixes, name in ((measurements.positions, "GPS fixes"), (measurements.ups, "attitudes")):
        if fixes is not None:
            _inside(fixes.stamps_s, stamps_s, name)


def _inside(
    stamps_s: Float64[np.ndarray, "N"], scan_stamps_s: Float64[np.ndarray, "S"], name: str
) -> Bool[np.ndarray, "N"]:
    first, last = scan_stamps_s[0] - CLOCK_TOLERANCE_S, scan_stamps_s[-1] + CLOCK_TOLERANCE_S
    inside = (stamps_s >= first) & (stamps_s <= last)
    if not inside.any():
        raise GraphError(
            f"the {name} are from {stamps_s[0]:.3f} to {stamps_s[-1]:.3f} s and the scans from "
            f"{scan_stamps_s[0]:.3f} to {scan_stamps_s[-1]:.3f} s; expected one clock"
        )
    return inside


def _place(
    stamps_s: Float64[np.ndarray, "N"], odometry: Trajectory, name: str
) -> tuple[Bool[np.ndarray, "N"], np.ndarray, Transforms]:
    """Return which fixes fall into the drive, their scans, and ``T_scan_lidar`` at their times."""
    inside = _inside(stamps_s, odometry.stamps_s, name)
    last = len(odometry) - 1
    scans = np.searchsorted(odometry.stamps_s, stamps_s[inside], side="right") - 1
    scans = np.clip(scans, 0, max(last - 1, 0))
    motions = [
        _motion(odometry, int(scan), min(int(scan) + 1, last), float(stamp_s))
        for scan, stamp_s in zip(scans, stamps_s[inside], strict=True)
    ]
    return inside, scans.astype(np.int64), np.array(motions)


def _motion(odometry: Trajectory, scan: int, following: int, stamp_s: float) -> Transform:
    span_s = float(odometry.stamps_s[following] - odometry.stamps_s[scan])
    if span_s <= 0.0:
        return np.eye(4)
    poses = odometry.T_world_lidar
    T_scan_following = invert(poses[scan]) @ poses[following]
    fraction = float(np.clip((stamp_s - odometry.stamps_s[scan]) / span_s, 0.0, 1.0))
    return interpolate(np.eye(4), T_scan_following, fraction)


def _huber(noise: gtsam.noiseModel.Base) -> gtsam.noiseModel.Base:
    loss = gtsam.noiseModel.mEstimator.Huber.Create(HUBER_SIGMAS)
    return gtsam.noiseModel.Robust.Create(loss, noise)

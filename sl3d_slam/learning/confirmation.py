"""Lines that a drive confirms: seen again, in the same place of the world, from somewhere else.

What only looks like a line moves with the sensor: the shadow's edge of a parked car, a ring of the
scan on the ground. What is one stays where it is. Poses may be true ones or odometry's, as scans
are compared over some metres only.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float64
from pydantic import Field

from sl3d_slam.config import Settings
from sl3d_slam.geometry.se3 import invert
from sl3d_slam.geometry.segments import (
    Segments,
    angles_rad,
    directions,
    lengths_m,
    midpoints,
    transform_segments,
)


class ConfirmationSettings(Settings):
    """When a line counts as seen again.

    It must lie within ``distance_m`` and ``angle_deg`` of a line of another scan that was taken
    between ``min_baseline_m`` and ``max_baseline_m`` away, in at least ``min_scans`` scans and in
    ``min_share`` of those. Where there are fewer such scans nothing is asked.
    """

    distance_m: float = Field(default=0.3, gt=0)
    angle_deg: float = Field(default=6.0, gt=0)
    min_baseline_m: float = Field(default=1.5, ge=0)
    max_baseline_m: float = Field(default=15.0, gt=0)
    min_scans: int = Field(default=3, ge=1)
    min_share: float = Field(default=0.25, ge=0, le=1)


def confirmed(
    found: Sequence[Float64[np.ndarray, "_ 2 3"]],
    T_world_lidar: Float64[np.ndarray, "S 4 4"],
    settings: ConfirmationSettings,
) -> list[Bool[np.ndarray, "_"]]:
    """Tell for every line of every scan (lidar frame) whether other scans confirm it."""
    places = T_world_lidar[:, :3, 3]
    verdicts = []
    for scan, segments in enumerate(found):
        baseline = np.linalg.norm(places - places[scan], axis=1)
        others = np.flatnonzero(
            (baseline >= settings.min_baseline_m) & (baseline <= settings.max_baseline_m)
        )
        if len(others) < settings.min_scans:
            verdicts.append(np.ones(len(segments), bool))
            continue
        count = np.zeros(len(segments), np.int64)
        for other in others.tolist():
            T_scan_other = invert(T_world_lidar[scan]) @ T_world_lidar[other]
            count += seen_again(segments, transform_segments(T_scan_other, found[other]), settings)
        needed = max(settings.min_scans, int(np.ceil(settings.min_share * len(others))))
        verdicts.append(count >= needed)
    return verdicts


def lines_of_others(
    scan: int,
    sure: Sequence[Float64[np.ndarray, "_ 2 3"]],
    T_world_lidar: Float64[np.ndarray, "S 4 4"],
    settings: ConfirmationSettings,
) -> Segments:
    """Return, in the frame of a scan, the lines of scans near by that are not among its own.

    A line that several of them found is taken from the nearest.
    """
    places = T_world_lidar[:, :3, 3]
    baseline = np.linalg.norm(places - places[scan], axis=1)
    others = np.flatnonzero(baseline <= settings.max_baseline_m)
    T_scan_world = invert(T_world_lidar[scan])
    known, own = sure[scan], len(sure[scan])
    for other in others[np.argsort(baseline[others], kind="stable")].tolist():
        if other != scan:
            local = transform_segments(T_scan_world @ T_world_lidar[other], sure[other])
            known = np.concatenate([known, local[~seen_again(local, known, settings)]])
    return known[own:]


def seen_again(
    segments: Segments, others: Float64[np.ndarray, "B 2 3"], settings: ConfirmationSettings
) -> Bool[np.ndarray, "L"]:
    """Tell which segments lie along one of the others; both in one frame."""
    if len(segments) == 0 or len(others) == 0:
        return np.zeros(len(segments), bool)
    middle_to_line, beyond = line_gaps_m(segments, others)
    angle = np.degrees(angles_rad(directions(segments), directions(others)))
    near = middle_to_line < settings.distance_m
    return np.any(near & (angle < settings.angle_deg) & (beyond <= 0.0), axis=1)


def line_gaps_m(
    segments: Float64[np.ndarray, "A 2 3"], others: Float64[np.ndarray, "B 2 3"]
) -> tuple[Float64[np.ndarray, "A B"], Float64[np.ndarray, "A B"]]:
    """Return the gap between two segments across and along the second, in metres.

    Across: from the middle of the first to the line of the second. Along: how far they are from
    overlapping; negative where they do.
    """
    along = directions(others)
    offset = midpoints(segments)[:, None] - midpoints(others)[None]
    lengthwise = np.einsum("abd,bd->ab", offset, along)
    squared = np.einsum("abd,abd->ab", offset, offset) - lengthwise**2
    half = 0.5 * (lengths_m(segments)[:, None] + lengths_m(others)[None])
    return np.sqrt(np.maximum(squared, 0.0)), np.abs(lengthwise) - half

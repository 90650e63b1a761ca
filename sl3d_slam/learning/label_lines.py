"""Which lines a scan is labelled with: its own that others confirm, and theirs that it shows."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64

from sl3d_slam.geometry.se3 import Points
from sl3d_slam.geometry.segments import Segments, directions, lengths_m
from sl3d_slam.learning.confirmation import ConfirmationSettings, confirmed, lines_of_others
from sl3d_slam.learning.labelling import Candidates
from sl3d_slam.learning.labels import close_to
from sl3d_slam.learning.line_growth import GrowthSettings, longest_run


@dataclass(frozen=True, slots=True, eq=False)
class ScanLines:
    """What is known of the lines of one scan (lidar frame).

    Attributes
    ----------
    votes : of its points.
    own : found in it and confirmed.
    nearby : confirmed by scans near by, not found in this one.
    doubtful : found in it, not confirmed.
    """

    votes: Float32[np.ndarray, "n"]
    own: Segments
    nearby: Float64[np.ndarray, "B 2 3"]
    doubtful: Float64[np.ndarray, "U 2 3"]


def judge_lines(
    found: Sequence[Candidates],
    T_world_lidar: Float64[np.ndarray, "S 4 4"],
    settings: ConfirmationSettings,
) -> list[ScanLines]:
    """Let the scans of a drive confirm each other's lines, and tell each other of them."""
    verdicts = confirmed([c.lines for c in found], T_world_lidar, settings)
    sure = [c.lines[verdict] for c, verdict in zip(found, verdicts, strict=True)]
    return [
        ScanLines(
            votes=c.votes,
            own=sure[scan],
            nearby=lines_of_others(scan, sure, T_world_lidar, settings),
            doubtful=np.concatenate([c.doubtful, c.lines[~verdicts[scan]]]),
        )
        for scan, c in enumerate(found)
    ]


def split_by_sight(
    points_lidar: Points, lines: ScanLines, settings: GrowthSettings
) -> tuple[Segments, Float64[np.ndarray, "U 2 3"]]:
    """Return the lines to label a scan with, and all that are doubtful in it.

    A confirmed line from near by counts, cut to what is seen of it, where the scan has points along
    it: it was only missed. Where it has none the line is hidden, or the pose is off: doubtful.
    """
    cut, shown = visible_parts(points_lidar, lines.nearby, settings)
    sure = np.concatenate([lines.own, cut])
    return sure, np.concatenate([lines.doubtful, lines.nearby[~shown]])


def visible_parts(
    points_lidar: Points, segments: Float64[np.ndarray, "B 2 3"], settings: GrowthSettings
) -> tuple[Segments, Bool[np.ndarray, "B"]]:
    """Return the parts of segments that a scan shows, and which of them it shows at all.

    A part has ``min_points`` points over ``min_length_m`` at least, and no gap over ``max_gap_m``.
    """
    parts = [_visible_part(points_lidar, segment, settings) for segment in segments]
    shown = np.array([part is not None for part in parts], bool)
    return np.array([part for part in parts if part is not None]).reshape(-1, 2, 3), shown


def _visible_part(
    points: Points, segment: Float64[np.ndarray, "2 3"], settings: GrowthSettings
) -> np.ndarray | None:
    axis, length_m = directions(segment[None])[0], lengths_m(segment[None])[0]
    near = points[close_to(points, segment[None], settings.reach_m)]
    along = (near - segment[0]) @ axis
    beside = near[(along >= 0) & (along <= length_m)]
    run = beside[longest_run(beside, (segment[0], axis), settings)]
    along = (run - segment[0]) @ axis
    if len(run) < settings.min_points or np.ptp(along) < settings.min_length_m:
        return None
    return segment[0] + np.array([[along.min()], [along.max()]]) * axis

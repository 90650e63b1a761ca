"""Standing lines that a drive confirms: found from several places, where odometry puts them.

A first set of labels for a raw drive, from geometry and motion alone. A line that the geometric
extractor finds in one scan only proves nothing; found again from elsewhere it is a landmark, and
it then labels the points of every scan near by, also of those where the extractor missed it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int32, Int64, UInt8
from scipy.spatial import cKDTree

from sl3d_slam.geometry.se3 import invert
from sl3d_slam.geometry.segments import transform_segments
from sl3d_slam.learning.prepared import BACKGROUND, IGNORED
from sl3d_slam.types import LineSet

SAME_PLACE_M = 0.3
MIN_SCANS, MIN_SHARE, MIN_BASELINE_M = 5, 0.35, 4.0
UNSURE_SCANS = 3
REACH_SCANS_M = 30.0
MEMBER_M, UNSURE_M = 0.2, 0.4
MIN_MEMBERS = 3


@dataclass(frozen=True, slots=True, eq=False)
class Landmarks:
    """Standing lines of a drive in its world frame.

    Attributes
    ----------
    endpoints : (L, 2, 3) lower end first, metres.
    kinds : (L,) values of :class:`sl3d_slam.types.LineKind`.
    confirmed : (L,) whether enough scans found it; the others label points as not known.
    first_scan, last_scan : (L,) between which scans it was found.
    """

    endpoints: Float64[np.ndarray, "L 2 3"]
    kinds: UInt8[np.ndarray, "L"]
    confirmed: np.ndarray
    first_scan: Int64[np.ndarray, "L"]
    last_scan: Int64[np.ndarray, "L"]


def find_landmarks(
    found: Sequence[LineSet], T_world_lidar: Float64[np.ndarray, "N 4 4"]
) -> Landmarks:
    """Bring the lines of all scans together: those within 0.3 m at mid-height are one landmark.

    Lines found in fewer than three scans are dropped: they do not come back, so they are nothing
    to learn.
    """
    scan_of = np.repeat(np.arange(len(found)), [len(lines) for lines in found])
    segments = [
        _upright(transform_segments(T, lines.endpoints))
        for T, lines in zip(T_world_lidar, found, strict=True)
    ]
    endpoints = np.concatenate([np.zeros((0, 2, 3)), *segments])
    kinds = np.concatenate([np.zeros(0, np.uint8), *(lines.kinds for lines in found)])
    groups = _groups(endpoints[:, :, :2].mean(axis=1), scan_of)
    groups = [group for group in groups if len(group) >= UNSURE_SCANS]
    rows = [_merged(endpoints[group]) for group in groups]
    confirmed = [_confirmed(scan_of[group], T_world_lidar[:, :3, 3]) for group in groups]
    return Landmarks(
        endpoints=np.array(rows).reshape(-1, 2, 3),
        kinds=np.array([np.bincount(kinds[group]).argmax() for group in groups], np.uint8),
        confirmed=np.array(confirmed, bool),
        first_scan=np.array([scan_of[group].min() for group in groups], np.int64),
        last_scan=np.array([scan_of[group].max() for group in groups], np.int64),
    )


def _confirmed(scans: Int64[np.ndarray, "G"], places: np.ndarray) -> bool:
    """Tell whether a line was found in enough of the scans that it was in view of, from afar too.

    What shrubs look like from one place is gone four metres on.
    """
    found = np.unique(scans)
    share = len(found) / (found[-1] - found[0] + 1)
    baseline_m = float(np.linalg.norm(np.ptp(places[found], axis=0)))
    return len(found) >= MIN_SCANS and share >= MIN_SHARE and baseline_m >= MIN_BASELINE_M


def label_points(
    points: np.ndarray, landmarks: Landmarks, T_world_lidar: np.ndarray, places: np.ndarray
) -> tuple[Int32[np.ndarray, "M"], Float64[np.ndarray, "L 2 3"], UInt8[np.ndarray, "L"]]:
    """Return the line of each point (lidar frame), and the lines that are labelled in this scan.

    ``places`` (N, 3) are where the drive's scans were taken: a landmark counts here where it was
    seen from within 30 m of this place.
    """
    here = T_world_lidar[:3, 3]
    span = np.stack([places[landmarks.first_scan], places[landmarks.last_scan]], axis=1)
    gap = np.linalg.norm(span - here, axis=2).min(axis=1)
    near = gap < REACH_SCANS_M
    local = transform_segments(invert(T_world_lidar), landmarks.endpoints[near])
    sure = landmarks.confirmed[near]
    kinds = landmarks.kinds[near]
    nearest, line = distances_to_segments(points, local)
    labels = np.full(len(points), BACKGROUND, np.int32)
    labels[nearest < UNSURE_M] = IGNORED
    member = (nearest < MEMBER_M) & sure[line] if len(local) else np.zeros(len(points), bool)
    counts = np.bincount(line[member], minlength=len(local))
    enough = counts >= MIN_MEMBERS
    renumber = np.cumsum(enough) - 1
    kept = member & enough[line] if len(local) else member
    labels[kept] = renumber[line[kept]]
    return labels, local[enough], kinds[enough]


def distances_to_segments(
    points: np.ndarray, segments: Float64[np.ndarray, "L 2 3"]
) -> tuple[Float64[np.ndarray, "M"], Int64[np.ndarray, "M"]]:
    """Return each point's distance to the nearest segment (inf without any) and which one it is."""
    best, line = np.full(len(points), np.inf), np.zeros(len(points), np.int64)
    for index, (a, b) in enumerate(segments):
        along = b - a
        t = np.clip((points - a) @ along / max(float(along @ along), 1e-9), 0.0, 1.0)
        distance = np.linalg.norm(points - a - t[:, None] * along, axis=1)
        nearer = distance < best
        best[nearer], line[nearer] = distance[nearer], index
    return best, line


def _upright(segments: np.ndarray) -> np.ndarray:
    """Put the lower end first."""
    swap = segments[:, 0, 2] > segments[:, 1, 2]
    return np.where(swap[:, None, None], segments[:, ::-1], segments)


def _groups(xy: np.ndarray, scan_of: np.ndarray) -> list[Int64[np.ndarray, "G"]]:
    """Gather lines around the busiest places first; each line goes to one group."""
    if len(xy) == 0:
        return []
    near = cKDTree(xy).query_ball_point(xy, SAME_PLACE_M)
    crowd = [len(set(scan_of[members].tolist())) for members in near]
    free, groups = np.ones(len(xy), bool), []
    for index in np.argsort(-np.array(crowd), kind="stable"):
        if free[index]:
            group = np.array([member for member in near[index] if free[member]], np.int64)
            free[group] = False
            groups.append(group)
    return groups


def _merged(segments: np.ndarray) -> np.ndarray:
    """Return the median line of a group, as long as most of its members were seen to be."""
    middle = np.median(segments.mean(axis=1), axis=0)
    along = segments[:, 1] - segments[:, 0]
    slope = np.median(along[:, :2] / np.maximum(along[:, 2:], 0.1), axis=0)
    low, high = np.quantile(segments[:, 0, 2], 0.25), np.quantile(segments[:, 1, 2], 0.75)
    heights = np.array([low, max(high, low + 0.5)])
    xy = middle[:2] + (heights - middle[2])[:, None] * slope
    return np.column_stack([xy, heights])

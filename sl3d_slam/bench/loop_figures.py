"""Precision and recall of loop detections against the true poses of a drive."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64
from scipy.spatial import cKDTree

from sl3d_slam.bench.loop_detectors import Detection
from sl3d_slam.bench.loop_revisits import Revisits
from sl3d_slam.bench.tables import Column, Row
from sl3d_slam.geometry.se3 import distance_m, invert, rotation_angle_rad

REACH_M = 5.0  # a loop speaks for the scans within this travel of it
CORRECT_M, CORRECT_DEG = 4.0, 10.0
DIRECTIONS = ("all", "same direction", "reverse")

COLUMNS = (
    Column("sequence", "sequence"),
    Column("kind", "data", main=False),
    Column("detector", "detector"),
    Column("direction", "revisits"),
    Column("num_revisits", "scans that revisit", "{:d}"),
    Column("detections", "detections", "{:d}"),
    Column("false", "false", "{:d}"),
    Column("precision_percent", "precision %", "{:.1f}"),
    Column("recall_percent", "recall %", "{:.1f}"),
    Column("f1_percent", "F1 %", "{:.1f}", main=False),
    Column("f1_max_percent", "F1 max %", "{:.1f}"),
    Column("recall_sure_percent", "recall at 100 % precision", "{:.1f}"),
    Column("recall_near_percent", "the same within 5 m", "{:.1f}"),
    Column("wall_s", "wall s", "{:.0f}", main=False),
    Column("status", "status"),
)
FALSE_COLUMNS = (
    Column("sequence", "sequence"),
    Column("detector", "detector"),
    Column("query_scan", "query scan", "{:d}"),
    Column("target_scan", "target scan", "{:d}"),
    Column("apart_m", "apart in truth m", "{:.1f}"),
    Column("off_m", "off m", "{:.1f}"),
    Column("off_deg", "off deg", "{:.1f}"),
    Column("score", "score", "{:.0f}"),
)
NOTES = (
    "A scan revisits where an earlier scan lies within 4 m, at least 40 m of travel ago, and holds "
    "30 % of its voxels of 1 m (of the fewer of the two); same direction or reverse by the angle "
    "between their headings (below or above 90 deg).",
    "Right: the claimed pose is within 4 m and 10 deg of the truth; for local maps this is "
    "looked at where the two truly come closest, so that their inner drift does not count.",
    "Recall: revisiting scans that a right detection speaks for: all that both sides were made of, "
    "and within 5 m of travel of those; a side is a scan of ours, a local map of 100 m for "
    "MapClosures. 'Within 5 m' counts alike for both: of the two scans where the sides come "
    "closest.",
    "Precision, recall, F1 at the detector's own threshold; F1 max and recall at 100 % precision "
    "over all thresholds of its score (inliers; for sl3d-slam accepted ones come first).",
    "Detections, false and precision do not depend on the direction.",
)

Poses = Float64[np.ndarray, "N 4 4"]
Sides = tuple[tuple[int, int], tuple[int, int]]  # first scan and the one after the last, of each


def meeting(detection: Detection, truth: Poses) -> tuple[int, int]:
    """Return the scan of the query and that of the target where the two truly come closest."""
    targets = cKDTree(truth[slice(*detection.target_scans), :3, 3])
    gaps_m, nearest = targets.query(truth[slice(*detection.query_scans), :3, 3])
    closest = int(np.argmin(gaps_m))
    return detection.query_scans[0] + closest, detection.target_scans[0] + int(nearest[closest])


def pose_error(detection: Detection, truth: Poses) -> tuple[float, float]:
    """Return metres and degrees that the claimed pose is off, where the two sides come closest."""
    closest = truth[meeting(detection, truth)[0]]
    T_target_closest = invert(truth[detection.target_frame]) @ closest
    T_query_closest = invert(truth[detection.query_frame]) @ closest
    T_error = invert(T_target_closest) @ detection.T_target_query @ T_query_closest
    return distance_m(T_error), float(np.degrees(rotation_angle_rad(T_error)))


def is_right(detection: Detection, truth: Poses) -> bool:
    """Tell whether the claimed pose is right."""
    off_m, off_deg = pose_error(detection, truth)
    return off_m <= CORRECT_M and off_deg <= CORRECT_DEG


def false_ones(detections: Sequence[Detection], truth: Poses) -> list[Row]:
    """Return a row for each accepted detection that is wrong, for whoever wants to look at it."""
    rows: list[Row] = []
    for detection in detections:
        off_m, off_deg = pose_error(detection, truth)
        if detection.accepted and not (off_m <= CORRECT_M and off_deg <= CORRECT_DEG):
            apart = truth[detection.query_frame, :3, 3] - truth[detection.target_frame, :3, 3]
            rows.append(
                {
                    "query_scan": detection.query_frame,
                    "target_scan": detection.target_frame,
                    "apart_m": float(np.linalg.norm(apart)),
                    "off_m": off_m,
                    "off_deg": off_deg,
                    "score": detection.score,
                }
            )
    return rows


def covered(sides: Sides, revisits: Revisits) -> Bool[np.ndarray, "P"]:
    """Tell which revisiting pairs lie in these sides, or within 5 m of travel of them."""
    inside = np.ones(len(revisits.pairs), np.bool_)
    for column, (first, stop) in enumerate(sides):
        at_m = revisits.travelled_m[revisits.pairs[:, column]]
        low_m, high_m = revisits.travelled_m[first], revisits.travelled_m[stop - 1]
        inside &= (at_m >= low_m - REACH_M) & (at_m <= high_m + REACH_M)
    return inside


@dataclass(frozen=True, slots=True, eq=False)
class Curve:
    """Precision and recall (fractions) as the threshold on the score falls.

    ``own`` are precision and recall at the detector's own threshold; precision is None where
    nothing was detected.
    """

    precision: Float64[np.ndarray, "K"]
    recall: Float64[np.ndarray, "K"]
    own: tuple[float | None, float]
    num_revisits: int

    def f1_max(self) -> float:
        """Return the best harmonic mean along the curve."""
        sums = np.maximum(self.precision + self.recall, 1e-12)
        return float((2.0 * self.precision * self.recall / sums).max(initial=0.0))

    def sure_recall(self) -> float:
        """Return the highest recall before the first false detection."""
        return float(self.recall[self.precision >= 1.0].max(initial=0.0))


def curve(
    detections: Sequence[Detection],
    sides: Sequence[Sides],
    right: Bool[np.ndarray, "D"],
    revisits: Revisits,
    direction: str,
) -> Curve:
    """Follow precision and recall over all thresholds; ties of the score enter together.

    ``sides`` are those that each detection speaks for.
    """
    chosen = revisits.of(direction)
    scans = np.unique(revisits.pairs[chosen, 0])
    best = np.full(int(revisits.travelled_m.size), -np.inf)
    own = np.zeros(len(best), np.bool_)
    for detection, spoken_for, good in zip(detections, sides, right, strict=True):
        if good:
            queries = revisits.pairs[chosen & covered(spoken_for, revisits), 0]
            best[queries] = np.maximum(best[queries], detection.score)
            own[queries] |= detection.accepted
    scores = np.array([detection.score for detection in detections])
    thresholds = np.unique(scores)[::-1]
    precision = np.array([right[scores >= limit].mean() for limit in thresholds])
    count = max(len(scans), 1)
    recall = np.array([(best[scans] >= limit).sum() / count for limit in thresholds])
    accepted = np.array([detection.accepted for detection in detections], np.bool_)
    own_precision = float(right[accepted].mean()) if accepted.any() else None
    return Curve(precision, recall, (own_precision, float(own[scans].sum()) / count), len(scans))


def judge(
    detections: Sequence[Detection], truth: Poses, revisits: Revisits
) -> tuple[list[Row], dict[str, Curve]]:
    """Return a row for all revisits, those in the same direction and those in reverse."""
    right = np.array([is_right(detection, truth) for detection in detections], np.bool_)
    accepted = np.array([detection.accepted for detection in detections], np.bool_)
    counts = {"detections": int(accepted.sum()), "false": int((accepted & ~right).sum())}
    whole = [(detection.query_scans, detection.target_scans) for detection in detections]
    met = [meeting(detection, truth) for detection in detections]
    near = [((query, query + 1), (target, target + 1)) for query, target in met]
    rows: list[Row] = []
    curves: dict[str, Curve] = {}
    for name in DIRECTIONS:
        curves[name] = curve(detections, whole, right, revisits, name)
        close = curve(detections, near, right, revisits, name)
        rows.append({"direction": name, **counts, **_figures(curves[name], close)})
    return rows, curves


def _figures(found: Curve, near: Curve) -> Row:
    precision, recall = found.own
    row: Row = {
        "num_revisits": found.num_revisits,
        "precision_percent": None if precision is None else 100.0 * precision,
    }
    if found.num_revisits == 0:
        return row
    f1 = 2.0 * (precision or 0.0) * recall / max((precision or 0.0) + recall, 1e-12)
    return {
        **row,
        "recall_percent": 100.0 * recall,
        "f1_percent": 100.0 * f1,
        "f1_max_percent": 100.0 * found.f1_max(),
        "recall_sure_percent": 100.0 * found.sure_recall(),
        "recall_near_percent": 100.0 * near.sure_recall(),
    }

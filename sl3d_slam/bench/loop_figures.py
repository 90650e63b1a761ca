"""Precision and recall of loop detections against the true poses of a drive."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.spatial import cKDTree

from sl3d_slam.bench.loop_detectors import Detection
from sl3d_slam.bench.tables import Column, Row
from sl3d_slam.geometry.se3 import distance_m, invert, rotation_angle_rad

REVISIT_M = 4.0
MIN_TRAVEL_M = 40.0
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
    "A scan revisits where an earlier scan lies within 4 m and at least 40 m of travel ago; same "
    "direction or reverse by the angle between their headings (below or above 90 deg).",
    "Right: the claimed pose is within 4 m and 10 deg of the truth; for local maps this is "
    "looked at where the two truly come closest, so that their inner drift does not count.",
    "Recall: revisiting scans that a right detection speaks for: within 5 m of travel of one of "
    "ours on both sides; anywhere in the two local maps of 100 m for MapClosures.",
    "Precision, recall, F1 at the detector's own threshold; F1 max and recall at 100 % precision "
    "over all thresholds of its score (inliers; for sl3d-slam accepted ones come first).",
    "Detections, false and precision do not depend on the direction.",
)

Poses = Float64[np.ndarray, "N 4 4"]


@dataclass(frozen=True, slots=True, eq=False)
class Revisits:
    """Pairs of scans (query later) at one place, and whether they look the other way."""

    pairs: Int64[np.ndarray, "P 2"]
    is_reverse: Bool[np.ndarray, "P"]
    travelled_m: Float64[np.ndarray, "N"]

    def of(self, direction: str) -> Bool[np.ndarray, "P"]:
        """Tell which pairs count for one of ``DIRECTIONS``."""
        if direction == "all":
            return np.ones(len(self.pairs), np.bool_)
        return self.is_reverse if direction == "reverse" else ~self.is_reverse


def find_revisits(truth: Poses) -> Revisits:
    """Return all pairs of scans within 4 m with at least 40 m of travel between."""
    positions = truth[:, :3, 3]
    steps_m = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    travelled_m = np.concatenate([[0.0], np.cumsum(steps_m)])
    near = cKDTree(positions).query_pairs(REVISIT_M, output_type="ndarray").astype(np.int64)
    near = np.sort(near.reshape(-1, 2), axis=1)[:, ::-1]
    pairs = near[travelled_m[near[:, 0]] - travelled_m[near[:, 1]] >= MIN_TRAVEL_M]
    headings = truth[:, :3, 0]
    cosines = np.sum(headings[pairs[:, 0]] * headings[pairs[:, 1]], axis=1)
    return Revisits(np.ascontiguousarray(pairs), cosines < 0.0, travelled_m)


def pose_error(detection: Detection, truth: Poses) -> tuple[float, float]:
    """Return metres and degrees that the claimed pose is off, where the two sides come closest."""
    queries = np.arange(*detection.query_scans)
    gaps_m, _ = cKDTree(truth[slice(*detection.target_scans), :3, 3]).query(truth[queries, :3, 3])
    closest = truth[queries[np.argmin(gaps_m)]]
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


def covered(detection: Detection, revisits: Revisits) -> Bool[np.ndarray, "P"]:
    """Tell which revisiting pairs a detection speaks for."""
    inside = np.ones(len(revisits.pairs), np.bool_)
    sides = (detection.query_scans, detection.target_scans)
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
    right: Bool[np.ndarray, "D"],
    revisits: Revisits,
    direction: str,
) -> Curve:
    """Follow precision and recall over all thresholds; ties of the score enter together."""
    chosen = revisits.of(direction)
    scans = np.unique(revisits.pairs[chosen, 0])
    best = np.full(int(revisits.travelled_m.size), -np.inf)
    own = np.zeros(len(best), np.bool_)
    for detection, good in zip(detections, right, strict=True):
        if good:
            queries = revisits.pairs[chosen & covered(detection, revisits), 0]
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


def judge(detections: Sequence[Detection], truth: Poses) -> tuple[list[Row], dict[str, Curve]]:
    """Return a row for all revisits, those in the same direction and those in reverse."""
    revisits = find_revisits(truth)
    right = np.array([is_right(detection, truth) for detection in detections], np.bool_)
    accepted = np.array([detection.accepted for detection in detections], np.bool_)
    curves = {name: curve(detections, right, revisits, name) for name in DIRECTIONS}
    counts = {"detections": int(accepted.sum()), "false": int((accepted & ~right).sum())}
    return [{"direction": name, **counts, **_figures(curves[name])} for name in DIRECTIONS], curves


def _figures(found: Curve) -> Row:
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
    }

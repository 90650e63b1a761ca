"""How good a method's answers are: recall, errors of successes, answers that were wrong."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from sl3d_slam.bench.registration_methods import Attempt
from sl3d_slam.bench.tables import Column, Row
from sl3d_slam.geometry.se3 import Transform, distance_m, invert, rotation_angle_rad

SUCCESS_M, SUCCESS_DEG = 2.0, 5.0

COLUMNS = (
    Column("pairs_of", "pairs"),
    Column("kind", "data", main=False),
    Column("method", "method"),
    Column("num_pairs", "n", "{:d}", main=False),
    Column("recall_percent", "recall %", "{:.1f}"),
    Column("rte_median_m", "RTE m (median)", "{:.3f}"),
    Column("rte_mean_m", "mean", "{:.3f}", main=False),
    Column("rte_std_m", "std", "{:.3f}", main=False),
    Column("rre_median_deg", "RRE deg (median)", "{:.3f}"),
    Column("rre_mean_deg", "mean", "{:.3f}", main=False),
    Column("rre_std_deg", "std", "{:.3f}", main=False),
    Column("wrong", "wrong", "{:d}"),
    Column("refused", "said no", "{:d}"),
    Column("total_ms", "total ms", "{:.0f}"),
    Column("extract_ms", "lines, features ms", "{:.0f}", main=False),
    Column("match_ms", "match ms", "{:.0f}", main=False),
    Column("status", "status"),
)
NOTES = (
    "Success: answered, and within 2 m and 5 deg of the truth. RTE and RRE: translation and "
    "rotation errors of successes. Wrong: answered, but outside.",
    "A method whose 'said no' is '-' always answers and never says no.",
    "Pairs of different places: 'wrong' counts those that were called a success.",
    "Times: mean of a pair, lines or features of both scans included, reading left out.",
    "Open3D: 0.5 m voxels, FPFH radius 2.5 m, RANSAC with mutual matches, 50,000 iterations at "
    "confidence 0.999; ICP point to plane from the identity. KISS-Matcher: 0.3 m voxels, an answer "
    "counts from 5 inliers.",
)
PEER_PAIRS = "Peers on the first {} pairs of each row's group only."


@dataclass(frozen=True, slots=True, eq=False)
class Errors:
    """Per pair: metres and degrees from the truth; infinite where the method said no."""

    rte_m: Float64[np.ndarray, "P"]
    rre_deg: Float64[np.ndarray, "P"]

    def successes(self) -> np.ndarray:
        """Tell which pairs are within 2 m and 5 deg."""
        return (self.rte_m <= SUCCESS_M) & (self.rre_deg <= SUCCESS_DEG)


def measure(attempts: Sequence[Attempt], truths: Sequence[Transform]) -> Errors:
    """Compare answers with the truth."""
    errors = np.full((len(attempts), 2), np.inf)
    for k, (attempt, T_true) in enumerate(zip(attempts, truths, strict=True)):
        if attempt.T_target_source is not None:
            T_error = invert(T_true) @ attempt.T_target_source
            errors[k] = distance_m(T_error), np.degrees(rotation_angle_rad(T_error))
    return Errors(errors[:, 0], errors[:, 1])


def figures(attempts: Sequence[Attempt], truths: Sequence[Transform | None]) -> Row:
    """Return the figures of one method on one group of pairs, all with truth or all without."""
    answered = sum(attempt.T_target_source is not None for attempt in attempts)
    can_refuse = any(attempt.can_refuse for attempt in attempts)
    row = {
        "num_pairs": len(attempts),
        "wrong": answered,
        "refused": len(attempts) - answered if can_refuse else None,
        "total_ms": _mean_ms([attempt.extract_s + attempt.match_s for attempt in attempts]),
        "extract_ms": _mean_ms([attempt.extract_s for attempt in attempts]),
        "match_ms": _mean_ms([attempt.match_s for attempt in attempts]),
    }
    known = [T_true for T_true in truths if T_true is not None]
    if len(known) < len(attempts) or not attempts:
        return row
    errors = measure(attempts, known)
    good = errors.successes()
    return {
        **row,
        "wrong": answered - int(good.sum()),
        "recall_percent": 100.0 * float(good.mean()),
        **_spread("rte", "m", errors.rte_m[good]),
        **_spread("rre", "deg", errors.rre_deg[good]),
    }


def recall_curve(
    errors: Float64[np.ndarray, "P"],
    allowed: np.ndarray,
    thresholds: Float64[np.ndarray, "K"],
) -> Float64[np.ndarray, "K"]:
    """Return the percentage of pairs that are ``allowed`` and within each threshold."""
    within = (errors[:, None] <= thresholds) & allowed[:, None]
    return 100.0 * within.mean(axis=0)


def _spread(name: str, unit: str, values: Float64[np.ndarray, "S"]) -> dict[str, float | None]:
    names = [f"{name}_{what}_{unit}" for what in ("median", "mean", "std")]
    if len(values) == 0:
        return dict.fromkeys(names)
    return dict(
        zip(names, map(float, (np.median(values), values.mean(), values.std())), strict=True)
    )


def _mean_ms(seconds: Sequence[float]) -> float | None:
    return 1e3 * float(np.mean(seconds)) if seconds else None

"""Figures of line extractors from counts on pairs of scans, each with its spread."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from sl3d_slam.bench.tables import Row

RESAMPLES = 1000


class PairCounts(NamedTuple):
    """What one method did on one pair of scans; lines of both scans together.

    ``tried`` is 1 where the pair was registered, then ``dense`` and ``alone`` tell whether that
    succeeded with clouds and by lines alone.
    """

    found: float  # lines, before the numbers were made equal
    used: float
    seen: float  # lines in the other scan's view
    again: float  # of those, found there, too
    matches: float  # true partners, each looked for from both sides
    first: float  # of those, ranked first by descriptor
    top: float
    chance_first: float  # what a descriptor that knows nothing would rank first
    chance_top: float
    tried: float = 0.0
    dense: float = 0.0
    alone: float = 0.0


class ScanCounts(NamedTuple):
    """What one method did on one scan whose true lines are known."""

    used: float
    right: float  # of those used, on a true line
    visible: float  # true lines that the sensor hit well enough
    hit: float  # of those, found
    visible_standing: float
    hit_standing: float
    found: float  # all lines, whatever their number
    found_right: float
    hit_by_all: float


SHARES = {
    "repeat": ("again", "seen"),
    "first": ("first", "matches"),
    "chance_first": ("chance_first", "matches"),
    "top": ("top", "matches"),
    "chance_top": ("chance_top", "matches"),
}
YES_OR_NO = {"registered": "dense", "registered_alone": "alone"}
TRUE_SHARES = {
    "precision": ("right", "used"),
    "recall": ("hit", "visible"),
    "recall_standing": ("hit_standing", "visible_standing"),
    "precision_all": ("found_right", "found"),
    "recall_all": ("hit_by_all", "visible"),
}


def pair_figures(counts: Sequence[PairCounts], baseline: Sequence[PairCounts] = ()) -> Row:
    """Return the figures of one method over pairs; shares are sums over sums.

    The spread is the standard deviation over 1,000 drawings of as many pairs with replacement.
    ``baseline`` holds another method's counts on the same pairs: the row then says how much more is
    found again, with the spread of that difference.
    """
    table = np.array(counts, float).reshape(-1, len(PairCounts._fields))
    row = {
        "num_pairs": len(table),
        "found_per_scan": _mean(table[:, 0]) / 2,
        "used_per_scan": _mean(table[:, 1]) / 2,
        "seen_per_pair": _mean(table[:, 2]) / 2,
        **_shares(table, PairCounts._fields, SHARES),
        **_registered(table),
    }
    if len(baseline) == len(counts) > 0:
        other = np.array(baseline, float)
        again, seen = (PairCounts._fields.index(name) for name in SHARES["repeat"])
        difference = _drawn(table[:, again], table[:, seen]) - _drawn(
            other[:, again], other[:, seen]
        )
        if np.isfinite(difference[0]):
            gain, spread = float(difference[0]), float(np.nanstd(difference[1:]))
            row["repeat_gain"] = f"{gain:+.0f} ± {spread:.0f}"
            row["repeat_gain_percent"], row["repeat_gain_spread"] = gain, spread
    return row


def scan_figures(counts: Sequence[ScanCounts]) -> Row:
    """Return the figures of one method against true lines; spreads are over scans."""
    table = np.array(counts, float).reshape(-1, len(ScanCounts._fields))
    return {
        "num_scans": len(table),
        "found_per_scan": _mean(table[:, 6]),
        "used_per_scan": _mean(table[:, 0]),
        "visible_per_scan": _mean(table[:, 2]),
        **_shares(table, ScanCounts._fields, TRUE_SHARES),
    }


def _shares(
    table: Float64[np.ndarray, "P F"], names: Sequence[str], shares: dict[str, tuple[str, str]]
) -> dict[str, object]:
    row: dict[str, object] = {}
    for name, (part, whole) in shares.items():
        drawn = _drawn(table[:, names.index(part)], table[:, names.index(whole)])
        if not np.isfinite(drawn[0]):
            row[name] = row[f"{name}_percent"] = row[f"{name}_spread"] = None
            continue
        value, spread = float(drawn[0]), float(np.nanstd(drawn[1:]))
        row[name] = f"{value:.0f} ± {spread:.0f}"
        row[f"{name}_percent"], row[f"{name}_spread"] = value, spread
    return row


def _registered(table: Float64[np.ndarray, "P F"]) -> dict[str, object]:
    """Return the share of pairs registered; the spread is that of the rate given the answers.

    With every rate as likely before (a Beta distribution after), 10 of 10 leave a spread, too.
    """
    tried = table[table[:, PairCounts._fields.index("tried")] > 0]
    row: dict[str, object] = {"num_registered": len(tried)}
    for name, part in YES_OR_NO.items():
        if len(tried) == 0:
            row[name] = row[f"{name}_percent"] = row[f"{name}_spread"] = None
            continue
        right = tried[:, PairCounts._fields.index(part)]
        rate = (right.sum() + 1.0) / (len(tried) + 2.0)
        spread = 100.0 * float(np.sqrt(rate * (1.0 - rate) / (len(tried) + 3.0)))
        row[f"{name}_percent"], row[f"{name}_spread"] = 100.0 * float(right.mean()), spread
        row[name] = f"{100.0 * right.mean():.0f} ± {spread:.0f}"
    return row


def _drawn(
    part: Float64[np.ndarray, "P"], whole: Float64[np.ndarray, "P"]
) -> Float64[np.ndarray, "R"]:
    """Return the percentage and, after it, that of each drawing; NaN where there is no whole."""
    picks = np.random.default_rng(0).integers(max(len(whole), 1), size=(RESAMPLES, len(whole)))
    parts = np.concatenate([[part.sum()], part[picks].sum(axis=1)])
    wholes = np.concatenate([[whole.sum()], whole[picks].sum(axis=1)])
    return np.asarray(100.0 * parts / np.where(wholes > 0, wholes, np.nan))


def _mean(values: Float64[np.ndarray, "P"]) -> float:
    return float(values.mean()) if len(values) else 0.0

"""Do answers come true as often as their confidence says?"""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from sl3d_slam.bench.tables import Column, Table

BOUNDS = (0.0, 0.5, 0.9, 0.97, 0.99, 1.0)
COLUMNS = (
    Column("confidence", "confidence"),
    Column("answers", "answers"),
    Column("promised_percent", "promised %", "{:.1f}"),
    Column("right_percent", "right %", "{:.1f}"),
)
NOTES = (
    "All answers of all maps by their confidence. Promised: its mean. Answers to scans of a town "
    "that is not in the map count as wrong. The confidence was fitted to other towns.",
)


def reliability(answers: Sequence[tuple[float, bool]]) -> Table:
    """Return a table of answers, each with its confidence and whether it was right."""
    confidence = np.array([one[0] for one in answers])
    right = np.array([one[1] for one in answers], np.bool_)
    cell = np.searchsorted(BOUNDS, confidence, side="right") - 1
    cell = np.clip(cell, 0, len(BOUNDS) - 2)
    rows: list[dict[str, Any]] = []
    for k, (low, high) in enumerate(pairwise(BOUNDS)):
        inside = cell == k
        row: dict[str, Any] = {"confidence": f"{low:g} to {high:g}", "answers": int(inside.sum())}
        if inside.any():
            row["promised_percent"] = 100.0 * float(confidence[inside].mean())
            row["right_percent"] = 100.0 * float(right[inside].mean())
        rows.append(row)
    return Table("Confidence of the answers", COLUMNS, rows, NOTES)

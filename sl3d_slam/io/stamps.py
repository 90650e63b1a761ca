"""Time stamps of a folder of scans, and rows of a table that belong to its scans."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from sl3d_slam.errors import InputError
from sl3d_slam.io.text_table import read_table

ASSUMED_RATE_HZ = 10.0


def read_stamps(
    path: Path, scans: Sequence[Path]
) -> tuple[Float64[np.ndarray, "N"], tuple[str, ...]]:
    """Return the seconds of each scan, and a warning where the file is absent and 10 Hz is assumed.

    Raises
    ------
    InputError
        naming the file where its times do not increase or do not fit the scans.
    """
    if not path.exists():
        warning = f"{path}: not found; the scans are taken to be {ASSUMED_RATE_HZ:g} a second"
        return np.arange(len(scans)) / ASSUMED_RATE_HZ, (warning,)
    stamps_s = pick_rows(read_table(path, 1, "one time in seconds a line"), scans, path)[:, 0]
    if np.any(np.diff(stamps_s) <= 0):
        raise InputError(f"{path}: times do not increase; expected one time in seconds a line")
    return stamps_s, ()


def pick_rows(rows: np.ndarray, scans: Sequence[Path], source: Path) -> np.ndarray:
    """Return one row a scan; where the counts differ, a scan's number is its row.

    So a part of a sequence works with the files of the whole. Raises InputError.
    """
    if len(rows) == len(scans):
        return rows
    numbers = [int(scan.stem) if scan.stem.isdecimal() else -1 for scan in scans]
    if min(numbers) < 0 or max(numbers) >= len(rows):
        raise InputError(
            f"{source}: has {len(rows)} rows for {len(scans)} scans; expected a row for each"
        )
    return rows[numbers]

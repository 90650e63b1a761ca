"""How many labels are right: found lines against the true lines of a simulated town."""

import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float64

from sl3d_slam.errors import InputError
from sl3d_slam.geometry.se3 import Transform, invert
from sl3d_slam.geometry.segments import Segments, lengths_m, transform_segments
from sl3d_slam.learning.confirmation import ConfirmationSettings, seen_again
from sl3d_slam.types import LineKind

TOLERANCE = ConfirmationSettings(distance_m=0.3, angle_deg=5.0)
MIN_SEEN_POINTS = 15
MIN_SEEN_M = 1.0
STANDING = (LineKind.POLE, LineKind.VERTICAL_EDGE)


@dataclass(frozen=True, slots=True)
class LabelScore:
    """Counts over scans: found lines that are right, and visible true lines that were found."""

    found: int = 0
    right: int = 0
    visible: int = 0
    recalled: int = 0

    def __add__(self, other: "LabelScore") -> "LabelScore":
        """Add the counts of two sets of scans."""
        return LabelScore(
            self.found + other.found,
            self.right + other.right,
            self.visible + other.visible,
            self.recalled + other.recalled,
        )

    @property
    def precision(self) -> float:
        """Share of the found lines that lie on a true one."""
        return self.right / max(self.found, 1)

    @property
    def recall(self) -> float:
        """Share of the visible true lines that were found."""
        return self.recalled / max(self.visible, 1)


@dataclass(frozen=True, slots=True, eq=False)
class TownTruth:
    """The true lines of a town (world frame) and which points of a scan lie on them."""

    folder: Path
    endpoints: Segments
    kinds: np.ndarray

    def score(
        self, scan_index: int, found: Segments, T_world_lidar: Transform, standing_only: bool
    ) -> LabelScore:
        """Judge the lines found in one scan (lidar frame).

        Right is a line within 0.3 m and 5 deg of any true line. A true line is visible where at
        least 15 points over 1 m of it were returned. Raises InputError.
        """
        true = transform_segments(invert(T_world_lidar), self.endpoints)
        right = seen_again(found, true, TOLERANCE)
        visible = self._visible(scan_index, standing_only)
        recalled = _partners(found, true[visible])
        return LabelScore(
            found=len(found),
            right=int(right.sum()),
            visible=len(visible),
            recalled=int(recalled.sum()),
        )

    def _visible(self, scan_index: int, standing_only: bool) -> np.ndarray:
        path = self.folder / "labels" / f"{scan_index:06d}.npz"
        line_id = _column(path, "line_id")
        counts = np.bincount(line_id[line_id >= 0], minlength=len(self.endpoints))
        wanted = (counts >= MIN_SEEN_POINTS) & (lengths_m(self.endpoints) >= MIN_SEEN_M)
        if standing_only:
            wanted &= np.isin(self.kinds, STANDING)
        return np.flatnonzero(wanted)


def read_town_truth(sequence: Path) -> TownTruth | None:
    """Return the truth beside a simulated sequence, or None where there is none.

    Raises
    ------
    InputError
        where ``lines.npz`` is damaged.
    """
    path = sequence / "lines.npz"
    if not path.is_file():
        return None
    return TownTruth(sequence, _column(path, "endpoints"), _column(path, "kinds"))


def _partners(found: Segments, true: Float64[np.ndarray, "V 2 3"]) -> Bool[np.ndarray, "V"]:
    """Tell which true lines a found one lies along, judged from the found one's middle."""
    hits = np.zeros(len(true), bool)
    for row in range(len(true)):
        hits[row] = bool(seen_again(found, true[row : row + 1], TOLERANCE).any())
    return hits


def _column(path: Path, name: str) -> np.ndarray:
    try:
        with np.load(path, allow_pickle=False) as file:
            return np.asarray(file[name])
    except (OSError, KeyError, ValueError, EOFError, zipfile.BadZipFile):
        raise InputError(
            f"{path}: cannot be read; expected {name} as sl3d simulate writes it"
        ) from None

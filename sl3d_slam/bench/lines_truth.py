"""Line extractors against the true lines of a simulated town."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.spatial import cKDTree

from sl3d_slam.bench.drives import Drive
from sl3d_slam.bench.lines_agreement import AGREE_M, gaps_m
from sl3d_slam.bench.lines_figures import ScanCounts
from sl3d_slam.bench.lines_sight import SEEN_RANGE_M
from sl3d_slam.errors import InputError
from sl3d_slam.geometry.se3 import Points, Transform, invert, make_transform
from sl3d_slam.geometry.segments import (
    Segments,
    directions,
    lengths_m,
    midpoints,
    transform_segments,
)
from sl3d_slam.io.folder import read_cloud
from sl3d_slam.simulation.primitives import Semantic
from sl3d_slam.types import LineSet

VISIBLE_POINTS, VISIBLE_M = 5, 0.8
STANDING_SINE = 0.8
REACH_M = 90.0
BESIDE_M = 0.4


@dataclass(frozen=True, slots=True, eq=False)
class TrueScan:
    """The true lines around one scan, in its lidar frame, and what each return lies on.

    Attributes
    ----------
    endpoints : (L, 2, 3) true lines within 90 m, seen or not.
    visible : which of them returned enough points within 40 m: 5, over 0.8 m of the line.
    points, semantics : all returns and what they lie on.
    """

    endpoints: Segments
    visible: Bool[np.ndarray, "L"]
    points: Points
    semantics: Int64[np.ndarray, "N"]


@dataclass(frozen=True, slots=True, eq=False)
class TrueTown:
    """The true lines of a simulated drive and the folder of its labels."""

    folder: Path
    endpoints_world: Segments
    T_world_lidar: Float64[np.ndarray, "S 4 4"]

    def at(self, index: int) -> TrueScan:
        """Return what is true of one scan. Raises InputError where its labels do not fit."""
        path = self.folder / "labels" / f"{index:06d}.npz"
        points = read_cloud(self.folder / "velodyne" / f"{index:06d}.bin").points
        labels = _arrays(path, ("line_id", "semantic"))
        lines, semantics = labels["line_id"].astype(np.int64), labels["semantic"].astype(np.int64)
        if len(lines) != len(points) or lines.max(initial=-1) >= len(self.endpoints_world):
            raise InputError(f"{path}: its labels do not fit the scan and lines.npz")
        endpoints = transform_segments(invert(self.T_world_lidar[index]), self.endpoints_world)
        visible = visible_lines(endpoints, points, lines)
        near = visible | (np.linalg.norm(midpoints(endpoints), axis=1) < REACH_M)
        return TrueScan(endpoints[near], visible[near], points, semantics)


def open_truth(drive: Drive) -> TrueTown | None:
    """Return the true lines of a drive, or None where it has none. Raises InputError."""
    root, name = Path(drive.data), drive.sequence
    named = [] if name is None else [root / "sequences" / name, root / name]
    places = named or [root, *root.glob("sequences/*")]
    known = [place for place in places if (place / "lines.npz").is_file()]
    if not known or drive.turned_back:
        return None
    folder = known[0]
    endpoints = _arrays(folder / "lines.npz", ("endpoints",))["endpoints"].astype(np.float64)
    path = folder / "T_world_lidar.txt"
    try:
        rows = np.loadtxt(path, ndmin=2).reshape(-1, 3, 4)
    except (OSError, ValueError):
        raise InputError(f"{path}: expected the true poses, 12 numbers a row") from None
    return TrueTown(folder, endpoints, np.array([_transform(row) for row in rows]))


def visible_lines(
    endpoints_lidar: Segments, points_lidar: Points, line_ids: Int64[np.ndarray, "N"]
) -> Bool[np.ndarray, "L"]:
    """Tell which true lines returned at least 5 points within 40 m, over at least 0.8 m."""
    kept = (line_ids >= 0) & (np.linalg.norm(points_lidar, axis=1) <= SEEN_RANGE_M)
    ids, points = line_ids[kept], points_lidar[kept]
    along = np.einsum(
        "ni,ni->n", points - endpoints_lidar[ids, 0], directions(endpoints_lidar)[ids]
    )
    low, high = np.full(len(endpoints_lidar), np.inf), np.full(len(endpoints_lidar), -np.inf)
    np.minimum.at(low, ids, along)
    np.maximum.at(high, ids, along)
    enough = np.bincount(ids, minlength=len(endpoints_lidar)) >= VISIBLE_POINTS
    return enough & (high - low >= VISIBLE_M)


def count_scan(truth: TrueScan, used: LineSet, found: LineSet) -> ScanCounts:
    """Count right lines, and true lines found."""
    agree = gaps_m(truth.endpoints, used.endpoints) <= AGREE_M
    agree_all = gaps_m(truth.endpoints, found.endpoints) <= AGREE_M
    standing = truth.visible & (np.abs(directions(truth.endpoints)[:, 2]) > STANDING_SINE)
    hit, hit_by_all = agree.any(axis=1), agree_all.any(axis=1)
    return ScanCounts(
        used=len(used),
        right=float(agree.any(axis=0).sum()),
        visible=float(truth.visible.sum()),
        hit=float((hit & truth.visible).sum()),
        visible_standing=float(standing.sum()),
        hit_standing=float((hit & standing).sum()),
        found=len(found),
        found_right=float(agree_all.any(axis=0).sum()),
        hit_by_all=float((hit_by_all & truth.visible).sum()),
    )


def false_ones_on(truth: TrueScan, lines: LineSet) -> Counter[str]:
    """Count what most returns within 0.4 m of each wrong line lie on."""
    wrong = ~(gaps_m(truth.endpoints, lines.endpoints) <= AGREE_M).any(axis=0)
    tree, on = cKDTree(truth.points), Counter[str]()
    for endpoints in lines.endpoints[wrong]:
        steps = np.linspace(0.0, 1.0, max(2, int(lengths_m(endpoints[None])[0] / BESIDE_M) + 1))
        walk = endpoints[0] + steps[:, None] * (endpoints[1] - endpoints[0])
        near = np.unique(np.concatenate(tree.query_ball_point(walk, BESIDE_M)).astype(np.int64))
        kinds = np.bincount(truth.semantics[near]) if len(near) else np.zeros(1, np.int64)
        on[Semantic(int(kinds.argmax())).name.lower() if len(near) else "nothing"] += 1
    return on


def in_words(on: Counter[str], most: int = 3) -> str:
    """Return the commonest with their percentages."""
    total = max(sum(on.values()), 1)
    return ", ".join(f"{name} {100 * n / total:.0f} %" for name, n in on.most_common(most))


def _transform(row: Float64[np.ndarray, "3 4"]) -> Transform:
    return make_transform(row[:, :3], row[:, 3])


def _arrays(path: Path, names: tuple[str, ...]) -> Mapping[str, np.ndarray]:
    try:
        with np.load(path, allow_pickle=False) as arrays:
            return {name: arrays[name] for name in names}
    except (OSError, ValueError, KeyError):
        expected = " and ".join(names)
        raise InputError(f"{path}: expected a simulated drive's arrays {expected}") from None

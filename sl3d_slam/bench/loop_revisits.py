"""Which scans of a drive revisit a place: near by the true poses, and with enough in common."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.spatial import cKDTree

from sl3d_slam.geometry.se3 import Transform, distances_travelled_m, transform_points
from sl3d_slam.mapping.voxels import voxel_keys
from sl3d_slam.types import Scan

REVISIT_M = 4.0
MIN_TRAVEL_M = 40.0
VOXEL_M, MIN_OVERLAP = 1.0, 0.3

Poses = Float64[np.ndarray, "N 4 4"]


@dataclass(frozen=True, slots=True, eq=False)
class Revisits:
    """Pairs of scans (query later) at one place, and whether they look the other way."""

    pairs: Int64[np.ndarray, "P 2"]
    is_reverse: Bool[np.ndarray, "P"]
    travelled_m: Float64[np.ndarray, "N"]

    def of(self, direction: str) -> Bool[np.ndarray, "P"]:
        """Tell which pairs count for all revisits, the same direction or reverse."""
        if direction == "all":
            return np.ones(len(self.pairs), np.bool_)
        return self.is_reverse if direction == "reverse" else ~self.is_reverse


def find_revisits(truth: Poses) -> Revisits:
    """Return all pairs of scans within 4 m with at least 40 m of travel between."""
    positions = truth[:, :3, 3]
    travelled_m = distances_travelled_m(positions)
    near = cKDTree(positions).query_pairs(REVISIT_M, output_type="ndarray").astype(np.int64)
    near = np.sort(near.reshape(-1, 2), axis=1)[:, ::-1]
    pairs = near[travelled_m[near[:, 0]] - travelled_m[near[:, 1]] >= MIN_TRAVEL_M]
    headings = truth[:, :3, 0]
    cosines = np.sum(headings[pairs[:, 0]] * headings[pairs[:, 1]], axis=1)
    return Revisits(np.ascontiguousarray(pairs), cosines < 0.0, travelled_m)


def that_overlap(revisits: Revisits, scans: Iterable[Scan], truth: Poses) -> Revisits:
    """Keep the pairs of scans with at least 30 % of their voxels (of the fewer) in common."""
    concerned = set(revisits.pairs.ravel().tolist())
    voxels = {
        scan.index: _touched(scan, truth[scan.index]) for scan in scans if scan.index in concerned
    }
    pairs = revisits.pairs.tolist()
    overlaps = np.array([_overlap(voxels[query], voxels[target]) for query, target in pairs])
    kept = overlaps >= MIN_OVERLAP
    return replace(revisits, pairs=revisits.pairs[kept], is_reverse=revisits.is_reverse[kept])


def _touched(scan: Scan, T_world_lidar: Transform) -> Int64[np.ndarray, "V"]:
    """Return the voxels of the world that a scan has points in, sorted."""
    return np.unique(voxel_keys(transform_points(T_world_lidar, scan.points_lidar), VOXEL_M))


def _overlap(a: Int64[np.ndarray, "A"], b: Int64[np.ndarray, "B"]) -> float:
    common = np.intersect1d(a, b, assume_unique=True)
    return len(common) / max(min(len(a), len(b)), 1)

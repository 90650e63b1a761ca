"""What else may change between two views: parts hidden, parts rebuilt, all a little larger.

A few real streets are soon known by heart, by what stands around each line. Where a part of the
surroundings is missing or foreign, in each of the two views another one, a line must be told by
what is left.
"""

import numpy as np
from jaxtyping import Bool

from sl3d_slam.learning.joint_settings import AugmentSettings
from sl3d_slam.learning.prepared import PreparedScan

HOLE_RADIUS_M = (1.0, 4.0)


def with_foreign_sector(
    scan: PreparedScan, other: PreparedScan, settings: AugmentSettings, rng: np.random.Generator
) -> PreparedScan:
    """Return a scan with a sector as the other one has it; the lines of the other come behind."""
    begin = rng.uniform(0.0, 2.0 * np.pi)
    width = np.radians(settings.max_foreign_deg) * rng.random()
    kept, taken = ~_in_sector(scan, begin, width), _in_sector(other, begin, width)
    foreign = other.line_ids[taken]
    ids = np.where(foreign >= 0, foreign + len(scan.endpoints), foreign)
    return PreparedScan(
        np.concatenate([scan.points[kept], other.points[taken]]),
        np.concatenate([scan.line_ids[kept], ids]).astype(np.int32),
        np.concatenate([scan.endpoints, other.endpoints]),
        np.concatenate([scan.kinds, other.kinds]),
    )


def with_holes(
    scan: PreparedScan, settings: AugmentSettings, rng: np.random.Generator
) -> PreparedScan:
    """Return a scan without what stands within one to four metres of some of its points."""
    kept = np.ones(len(scan.points), bool)
    for _ in range(int(rng.integers(settings.max_holes + 1)) if len(kept) else 0):
        middle = scan.points[int(rng.integers(len(kept))), :2]
        offset = scan.points[:, :2] - middle
        kept &= np.einsum("ij,ij->i", offset, offset) > rng.uniform(*HOLE_RADIUS_M) ** 2
    return PreparedScan(scan.points[kept], scan.line_ids[kept], scan.endpoints, scan.kinds)


def scaled(scan: PreparedScan, factor: float) -> PreparedScan:
    """Return a scan of a street that is larger by a factor."""
    points = scan.points * np.float32(factor)
    return PreparedScan(points, scan.line_ids, scan.endpoints * np.float32(factor), scan.kinds)


def _in_sector(scan: PreparedScan, begin: float, width: float) -> Bool[np.ndarray, "M"]:
    azimuth = np.arctan2(scan.points[:, 1], scan.points[:, 0])
    inside: Bool[np.ndarray, M] = (azimuth - begin) % (2.0 * np.pi) < width
    return inside

"""The same scan as another sensor, standing askew and turned, would have seen it."""

import numpy as np
from jaxtyping import Bool, Float64
from scipy.spatial.transform import Rotation

from sl3d_slam.learning.joint_settings import AugmentSettings
from sl3d_slam.learning.prepared import IGNORED, PreparedScan

THINNING_RANGE_M = 50.0
BEAM_STEPS_DEG = (0.8, 2.7)
VOXEL_M = 0.25


def augment(
    scan: PreparedScan,
    settings: AugmentSettings,
    max_points: int,
    mirrored: bool,
    rng: np.random.Generator,
) -> PreparedScan:
    """Return a scan turned by any yaw and a small tilt, thinned, with noise, perhaps mirrored.

    ``mirrored`` must be the same for both scans of a pair. Lines keep their rows; a line may lose
    all its points.
    """
    places = scan.points[:, :3].astype(np.float64)
    kept = _thinned(places, settings, rng) & _beams(places, settings, rng)
    rows = np.flatnonzero(kept)
    if len(rows) > max_points:
        squared = np.einsum("ij,ij->i", places[rows], places[rows])
        rows = rows[np.sort(np.argpartition(squared, max_points - 1)[:max_points])]
    rotation = _turn(settings, mirrored, rng)
    turned = places[rows] @ rotation.T + rng.normal(0.0, settings.noise_m, (len(rows), 3))
    heights = scan.points[rows, 3] + rng.normal(0.0, settings.height_noise_m)
    return PreparedScan(
        np.column_stack([turned, heights]).astype(np.float32),
        scan.line_ids[rows],
        (scan.endpoints @ rotation.T).astype(np.float32),
        scan.kinds,
    )


def _turn(
    settings: AugmentSettings, mirrored: bool, rng: np.random.Generator
) -> Float64[np.ndarray, "3 3"]:
    """Draw a yaw and a tilt; mirrored, the matrix is no rotation."""
    axis = rng.uniform(0.0, 2 * np.pi)
    tilt = np.radians(settings.max_tilt_deg) * rng.uniform(-1.0, 1.0)
    lean = Rotation.from_rotvec(tilt * np.array([np.cos(axis), np.sin(axis), 0.0]))
    yaw = Rotation.from_euler("z", rng.uniform(0.0, 2 * np.pi))
    side = -1.0 if mirrored else 1.0
    return (lean * yaw).as_matrix() @ np.diag([1.0, side, 1.0])


def _thinned(
    points: np.ndarray, settings: AugmentSettings, rng: np.random.Generator
) -> Bool[np.ndarray, "M"]:
    """Lose points by chance, the more the farther away."""
    worst = rng.uniform(0.0, settings.max_thinning)
    ranges = np.linalg.norm(points, axis=1)
    lost = worst * np.minimum(ranges / THINNING_RANGE_M, 1.0)
    return rng.random(len(points)) >= lost


def _beams(
    points: np.ndarray, settings: AugmentSettings, rng: np.random.Generator
) -> Bool[np.ndarray, "M"]:
    """In some clouds keep every other stripe of elevation, where stripes are wider than a voxel."""
    if rng.random() >= settings.beam_share:
        return np.ones(len(points), bool)
    step = np.radians(rng.uniform(*BEAM_STEPS_DEG))
    ranges = np.linalg.norm(points, axis=1)
    elevation = np.arcsin(points[:, 2] / np.maximum(ranges, 1e-6)) + rng.uniform(0.0, step)
    odd = np.floor(elevation / (0.5 * step)).astype(np.int64) % 2 == 1
    return ~(odd & (0.5 * step * ranges > VOXEL_M))


def visible_lines(scan: PreparedScan, min_members: int) -> Bool[np.ndarray, "L"]:
    """Tell which lines of a scan still have enough points."""
    ids = scan.line_ids[scan.line_ids >= 0]
    return np.bincount(ids, minlength=len(scan.endpoints)) >= min_members


def without_faint_lines(scan: PreparedScan, min_members: int) -> PreparedScan:
    """Mark the points of lines with too few of them as not known."""
    visible = visible_lines(scan, min_members)
    ids = scan.line_ids.copy()
    on_line = np.flatnonzero(ids >= 0)
    faint = ~visible[ids[on_line]]
    ids[on_line[faint]] = IGNORED
    return PreparedScan(scan.points, ids, scan.endpoints, scan.kinds)

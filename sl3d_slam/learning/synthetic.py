"""Synthetic clouds with exact labels: corners and poles, perturbed, beside clips of scans.

Cloud ``index`` of ``seed`` is made when it is asked for and always the same; nothing is stored.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Int64, UInt8
from pydantic import Field
from scipy.spatial.transform import Rotation

from sl3d_slam.config import Settings
from sl3d_slam.geometry.se3 import Points, make_transform
from sl3d_slam.learning.background import Clip
from sl3d_slam.learning.primitives import (
    BACKGROUND,
    Primitive,
    make_corner,
    make_pole,
    sample_surface,
)
from sl3d_slam.learning.scan_rings import ScanRings, random_rings

SPACING_M = 22.0
TILT_DEG = 4.0
PERTURBATION, SCANNED_PERTURBATION = (0.2, 1.0), (0.02, 0.2)
OVERSAMPLING = 20


class SyntheticSettings(Settings):
    """The make-up of a cloud.

    ``perturbation`` is the largest shift of a coordinate, as a share of the size of its shape; a
    cloud draws its own strength from 0.2 to 1 times that. ``max_primitives`` shapes at most share
    the points, so that lines are seen as densely as near and as far things are in a scan; 1 is the
    paper's. A point belongs to an edge within ``reach`` mean point spacings of it. A share of
    ``scanned`` clouds is sampled in rings, as a sensor does, and shifted less: a network that knows
    even samples alone takes rings for lines. 0 is the paper's.
    """

    primitive_points: int = Field(default=4000, ge=50)
    background_points: int = Field(default=1000, ge=0)
    perturbation: float = Field(default=0.05, ge=0, lt=0.5)
    max_primitives: int = Field(default=8, ge=1)
    reach: float = Field(default=1.0, gt=0)
    scanned: float = Field(default=0.75, ge=0, le=1)


@dataclass(frozen=True, slots=True, eq=False)
class SyntheticCloud:
    """One cloud, scaled into the unit cube.

    Attributes
    ----------
    points : (N, 3), all coordinates in [0, 1].
    line_id : (N,) row of the line a point belongs to, -1 for background.
    kinds : (N,) what that line is, values of LineKind; UNKNOWN for background.
    endpoints : (L, 2, 3) the true lines.
    """

    points: Float32[np.ndarray, "N 3"]
    line_id: Int64[np.ndarray, "N"]
    kinds: UInt8[np.ndarray, "N"]
    endpoints: Float32[np.ndarray, "L 2 3"]


def synthetic_cloud(
    seed: int,
    index: int,
    clips: tuple[Clip, ...],
    settings: SyntheticSettings = SyntheticSettings(),  # noqa: B008  (frozen)
) -> SyntheticCloud:
    """Return cloud ``index`` of ``seed``: shapes side by side and a clip of a scan, shuffled."""
    rng = np.random.default_rng([seed, index])
    count = int(rng.integers(1, settings.max_primitives + 1))
    shapes = [_placed(row, rng) for row in range(count)]
    points, line_id = _sample(shapes, settings, rng)
    lines = np.concatenate([shape.lines for shape in shapes])
    kinds = np.concatenate([shape.kinds for shape in shapes])
    if settings.background_points and clips:
        clip = clips[int(rng.integers(len(clips)))]
        rows = rng.choice(len(clip), settings.background_points, replace=True)
        rows[: len(clip)] = rng.permutation(len(clip))[: len(rows)]
        points = np.concatenate([points, _spun(clip[rows], rng) + _place(count)])
        line_id = np.concatenate([line_id, np.full(len(rows), BACKGROUND)])
    order = rng.permutation(len(points))
    points, line_id = points[order], line_id[order]
    low, extent = points.min(axis=0), float(np.ptp(points, axis=0).max())
    return SyntheticCloud(
        points=((points - low) / extent).astype(np.float32),
        line_id=line_id,
        kinds=np.append(kinds, np.uint8(0))[line_id],
        endpoints=((lines - low) / extent).astype(np.float32),
    )


def perturbed(
    points: Points, size_m: float, perturbation: float, rng: np.random.Generator
) -> Points:
    """Shift every coordinate evenly by up to ``perturbation`` times the size of the shape."""
    return points + perturbation * size_m * rng.uniform(-1.0, 1.0, points.shape)


def _sample(
    shapes: list[Primitive], settings: SyntheticSettings, rng: np.random.Generator
) -> tuple[Points, Int64[np.ndarray, "N"]]:
    """Spread the points over all shapes evenly by area; number the lines through."""
    areas = np.array([shape.areas_m2.sum() for shape in shapes])
    reach_m = settings.reach * float(np.sqrt(areas.sum() / settings.primitive_points))
    rings = _rings_around(len(shapes), settings, rng)
    least, most = PERTURBATION if rings is None else SCANNED_PERTURBATION
    strength = settings.perturbation * rng.uniform(least, most)
    drawn = settings.primitive_points * (1 if rings is None else OVERSAMPLING)
    shares = rng.multinomial(drawn, areas / areas.sum())
    clouds, ids, hits, first = [], [], [], 0
    for shape, share in zip(shapes, shares, strict=True):
        points, line_id = sample_surface(shape, int(share), reach_m, rng)
        hits.append(np.ones(len(points), bool) if rings is None else rings.hit(points))
        clouds.append(perturbed(points, shape.size_m, strength, rng))
        ids.append(np.where(line_id >= 0, line_id + first, BACKGROUND))
        first += len(shape.lines)
    hit = np.flatnonzero(np.concatenate(hits))
    if len(hit) < settings.primitive_points:  # all of it lies between two rings
        hit = np.arange(drawn)
    kept = rng.permutation(hit)[: settings.primitive_points]
    return np.concatenate(clouds)[kept], np.concatenate(ids)[kept]


def _rings_around(
    count: int, settings: SyntheticSettings, rng: np.random.Generator
) -> ScanRings | None:
    """Return the sensor that samples a cloud, or None where points are drawn evenly."""
    if rng.random() >= settings.scanned:
        return None
    return random_rings(_place(int(rng.integers(count))), rng)


def _placed(row: int, rng: np.random.Generator) -> Primitive:
    """Return a corner or a pole, as often one as the other, turned about z and tilted a little."""
    shape = make_pole(rng) if rng.random() < 0.5 else make_corner(rng)
    tilt_deg = rng.uniform(-TILT_DEG, TILT_DEG, 2)
    turn = Rotation.from_euler("zyx", [rng.uniform(0.0, 360.0), *tilt_deg], degrees=True)
    return shape.moved(make_transform(turn.as_matrix(), _place(row)))


def _place(row: int) -> Float64[np.ndarray, "3"]:
    """Return the place of the row-th thing on a square grid, so that nothing overlaps."""
    return SPACING_M * np.array([row % 3, row // 3, 0.0])


def _spun(points: Points, rng: np.random.Generator) -> Points:
    turn = Rotation.from_euler("z", rng.uniform(0.0, 2.0 * np.pi)).as_matrix()
    return points @ turn.T

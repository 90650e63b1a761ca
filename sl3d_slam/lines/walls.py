"""Upright planar patches of walls, with their true extent."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from sl3d_slam.lines.scene import Scene
from sl3d_slam.lines.sheets import grow_sheets

MAX_THICKNESS_M = 0.08
MIN_WIDTH_M = 0.12
MIN_CORE_BINS = 3
MIN_VOXELS = 25
MIN_LENGTH_M = 0.8
MIN_TOP_M = 1.65
ON_PLANE_M = 0.1
MAX_GAP_M = 0.4


@dataclass(frozen=True, slots=True, eq=False)
class Wall:
    """An upright planar patch: ``normal . xy = offset`` in the level frame.

    ``along`` is the horizontal direction in the patch, ``positions`` (N,) where its voxels lie on
    it, ascending.
    """

    voxels: Int64[np.ndarray, "N"]
    along: Float64[np.ndarray, "2"]
    normal: Float64[np.ndarray, "2"]
    offset: float
    positions: Float64[np.ndarray, "N"]

    def near(self, position: float, reach_m: float) -> Int64[np.ndarray, "M"]:
        """Return the voxels within a distance of a place along the wall."""
        begin, stop = np.searchsorted(self.positions, (position - reach_m, position + reach_m))
        return self.voxels[begin:stop]


def find_walls(scene: Scene, grow_radius_m: float) -> list[Wall]:
    """Return the walls of a scene that stand higher than a car, best seed first."""
    core, thickness, width = scene.structure[:, 0], scene.structure[:, 4], scene.structure[:, 5]
    seeds = np.flatnonzero(
        (thickness < MAX_THICKNESS_M) & (width > MIN_WIDTH_M) & (core >= MIN_CORE_BINS)
    )
    seeds = seeds[np.argsort(thickness[seeds], kind="stable")]
    normals = np.ascontiguousarray(scene.structure[:, 2:4])
    labels = grow_sheets(
        scene.points, normals, seeds, scene.index, scene.half_width_m, grow_radius_m
    )
    order = np.argsort(labels, kind="stable")
    order = order[np.searchsorted(labels[order], 0) :]
    if len(order) == 0:
        return []
    groups = np.split(order, np.flatnonzero(np.diff(labels[order])) + 1)
    walls = (_fit_wall(scene, group) for group in groups if len(group) >= MIN_VOXELS)
    return [wall for wall in walls if wall is not None]


def _fit_wall(scene: Scene, voxels: Int64[np.ndarray, "N"]) -> Wall | None:
    """Fit a vertical plane with weights that ignore what hangs on the wall."""
    if np.sort(scene.heights[voxels])[int(0.98 * (len(voxels) - 1))] < MIN_TOP_M:
        return None
    plan = scene.points[voxels, :2]
    weights = np.ones(len(plan))
    for _ in range(4):
        mean = weights @ plan / weights.sum()
        centred = plan - mean
        vectors = np.linalg.eigh((centred * weights[:, None]).T @ centred)[1]
        weights = 1.0 / (1.0 + (centred @ vectors[:, 0] / 0.05) ** 2) ** 2
    along, normal = vectors[:, 1], vectors[:, 0]
    positions = np.sort(plan @ along)
    first, last = positions[len(positions) // 50], positions[-1 - len(positions) // 50]
    if last - first < MIN_LENGTH_M:
        return None
    return _extended(scene, (along, normal, float(normal @ mean)), (float(first), float(last)))


def _extended(
    scene: Scene,
    plane: tuple[Float64[np.ndarray, "2"], Float64[np.ndarray, "2"], float],
    span: tuple[float, float],
) -> Wall:
    """Follow a patch past its first members: near a corner no point looks like part of a sheet."""
    along, normal, offset = plane
    x, y = scene.points[:, 0], scene.points[:, 1]
    on_plane = np.flatnonzero(np.abs(x * normal[0] + y * normal[1] - offset) < ON_PLANE_M)
    positions = x[on_plane] * along[0] + y[on_plane] * along[1]
    order = np.argsort(positions, kind="stable")
    on_plane, positions = on_plane[order], positions[order]
    breaks = np.flatnonzero(np.diff(positions) > MAX_GAP_M)
    begin, stop = np.searchsorted(positions, span)
    first = breaks[breaks < begin].max(initial=-1) + 1
    last = breaks[breaks >= stop - 1].min(initial=len(positions) - 1) + 1
    kept = slice(int(first), int(last))
    return Wall(on_plane[kept], along, normal, offset, positions[kept])

"""Upright planar patches of walls, with their true extent."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from sl3d_slam.lines.scene import Scene
from sl3d_slam.lines.sheets import grow_sheets
from sl3d_slam.lines.wall_fit import connected_on_plane, fit_plane

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
    normal, offset = fit_plane(plan)
    along = np.array([normal[1], -normal[0]])
    positions = np.sort(plan @ along)
    first, last = positions[len(positions) // 50], positions[-1 - len(positions) // 50]
    if last - first < MIN_LENGTH_M:
        return None
    # past the first members: near a corner no point looks like part of a sheet
    members, places = connected_on_plane(
        scene.points, (normal, offset), (float(first), float(last)), (ON_PLANE_M, MAX_GAP_M)
    )
    return Wall(members, along, normal, offset, places)

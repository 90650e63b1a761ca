"""A town on one day, arranged for ray casting, and the cast itself."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Int64, UInt8

from sl3d_slam.geometry.se3 import Points, Transform
from sl3d_slam.simulation.ground import Ground
from sl3d_slam.simulation.primitives import NUM_PARAMETERS, Primitives, bounds
from sl3d_slam.simulation.raycast import Beams, SceneArrays, cast
from sl3d_slam.simulation.sensor import Sensor

CELL_M = 4.0
MAX_MOVING = 4096
MAX_NODES = 8 * MAX_MOVING


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedScan:
    """One sweep, taken in an instant, with its truth.

    Attributes
    ----------
    points_lidar : (N, 3) metres, beam by beam.
    intensities : (N,) in [0, 1).
    labels : (N,) what each point lies on, values of ``Semantic``.
    line_ids : (N,) row of the true line that a point belongs to, -1 where there is none.
    """

    points_lidar: Points
    intensities: Float32[np.ndarray, "N"]
    labels: UInt8[np.ndarray, "N"]
    line_ids: Int64[np.ndarray, "N"]


@dataclass(slots=True, eq=False)
class Scene:
    """Ground, still primitives in a grid of cells, and room for those that move."""

    arrays: SceneArrays
    num_still: int

    def move(self, moving: Primitives) -> None:
        """Replace what moves; what was there before is gone."""
        arrays = self.arrays
        count = min(len(moving), MAX_MOVING)
        rows = slice(self.num_still, self.num_still + count)
        arrays.kinds[rows] = moving.kinds[:count]
        arrays.parameters[rows] = moving.parameters[:count]
        arrays.materials[rows] = moving.materials[:count]
        arrays.edges[rows] = moving.edges[:count]
        arrays.heads[:] = -1
        cells, items = _cells_of(bounds(moving)[:count], arrays.layout, arrays.heads.shape)
        for node, (cell, item) in enumerate(zip(cells[:MAX_NODES], items, strict=False)):
            row, column = divmod(int(cell), arrays.heads.shape[1])
            arrays.nodes[node] = self.num_still + item, arrays.heads[row, column]
            arrays.heads[row, column] = node


def build_scene(ground: Ground, still: list[Primitives]) -> Scene:
    """Arrange ground and primitives for ray casting."""
    kinds = np.concatenate([p.kinds for p in still] + [np.zeros(MAX_MOVING, np.uint8)])
    parameters = np.vstack([p.parameters for p in still] + [np.zeros((MAX_MOVING, NUM_PARAMETERS))])
    materials = np.vstack([p.materials for p in still] + [np.zeros((MAX_MOVING, 3))])
    edges = np.vstack([p.edges for p in still] + [np.full((MAX_MOVING, 4), -1, np.int64)])
    boxes = np.vstack([bounds(p) for p in still])
    extent = np.array(ground.grid.shape[:2]) * ground.spacing_m
    shape = (int(extent[0] / CELL_M) + 1, int(extent[1] / CELL_M) + 1)
    layout = np.array([*ground.low, ground.spacing_m, CELL_M])
    cells, items = _cells_of(boxes, layout, shape)
    tops = np.full(shape[0] * shape[1], -np.inf)
    np.maximum.at(tops, cells, boxes[items, 5])
    order = np.argsort(cells, kind="stable")
    starts = np.searchsorted(cells[order], np.arange(shape[0] * shape[1] + 1))
    heads = np.full(shape, -1, np.int64)
    nodes = np.zeros((MAX_NODES, 2), np.int64)
    arrays = SceneArrays(
        ground.grid,
        layout,
        kinds,
        parameters,
        materials,
        edges,
        starts,
        items[order],
        tops,
        heads,
        nodes,
    )
    return Scene(arrays, len(boxes))


def _cells_of(
    boxes: Float64[np.ndarray, "P 6"], layout: Float64[np.ndarray, "4"], shape: tuple[int, int]
) -> tuple[Int64[np.ndarray, "K"], Int64[np.ndarray, "K"]]:
    """Return (cell, primitive) pairs for every cell that a primitive's bounds touch."""
    limit = np.array([shape[1] - 1, shape[0] - 1])
    low = np.clip(((boxes[:, :2] - layout[:2]) / layout[3]).astype(int), 0, limit)
    high = np.clip(((boxes[:, 3:5] - layout[:2]) / layout[3]).astype(int), 0, limit)
    size = high - low + 1
    count = size[:, 0] * size[:, 1]
    items = np.repeat(np.arange(len(boxes)), count)
    rank = np.arange(len(items)) - np.repeat(np.cumsum(count) - count, count)
    i = low[items, 0] + rank % np.maximum(size[items, 0], 1)
    j = low[items, 1] + rank // np.maximum(size[items, 0], 1)
    return j * shape[1] + i, items


def cast_scan(
    scene: Scene, T_town_lidar: Transform, sensor: Sensor, scan_index: int, seed: int
) -> SimulatedScan:
    """Take one sweep; the same arguments give the same points on any number of threads."""
    key = int(np.random.SeedSequence([seed, scan_index]).generate_state(1, np.uint64)[0])
    directions = sensor.directions(phase=(key % 1000) / 1000.0)
    numbers = np.array(
        [
            sensor.min_range_m,
            sensor.max_range_m,
            sensor.range_noise_m,
            sensor.lost_share,
            sensor.detection_threshold,
        ]
    )
    out = np.empty((len(directions), 4))
    cast(scene.arrays, Beams(directions, numbers), T_town_lidar, np.uint64(key), out)
    seen = np.isfinite(out[:, 0])
    out = out[seen]
    points = directions[seen] * out[:, :1]
    intensities, labels = out[:, 1].astype(np.float32), out[:, 2].astype(np.uint8)
    return SimulatedScan(points, intensities, labels, out[:, 3].astype(np.int64))

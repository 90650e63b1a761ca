"""A town on one day, arranged for ray casting, and the cast itself."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float32, Int64, UInt8
from numba import config

from sl3d_slam.geometry.se3 import Points, Transform
from sl3d_slam.simulation.cells import cells_of
from sl3d_slam.simulation.ground import Ground
from sl3d_slam.simulation.primitives import NO_LINE, NUM_PARAMETERS, Primitives, bounds, joined
from sl3d_slam.simulation.raycast import Beams, cast
from sl3d_slam.simulation.sensor import Sensor
from sl3d_slam.simulation.traverse import SceneArrays

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
        rows = slice(self.num_still, self.num_still + len(moving))
        arrays.kinds[rows] = moving.kinds
        arrays.parameters[rows] = moving.parameters
        arrays.materials[rows] = moving.materials
        arrays.edges[rows] = moving.edges
        arrays.heads[:] = -1
        cells, items = cells_of(moving, arrays.layout, arrays.heads.shape)
        for node, (cell, item) in enumerate(zip(cells, items, strict=True)):
            row, column = divmod(int(cell), arrays.heads.shape[1])
            arrays.nodes[node] = self.num_still + item, arrays.heads[row, column]
            arrays.heads[row, column] = node


def build_scene(ground: Ground, still: list[Primitives]) -> Scene:
    """Arrange ground and primitives for ray casting."""
    room = Primitives(
        np.zeros(MAX_MOVING, np.uint8),
        np.zeros((MAX_MOVING, NUM_PARAMETERS)),
        np.zeros((MAX_MOVING, 3)),
        np.full((MAX_MOVING, 4), NO_LINE, np.int64),
    )
    standing = joined(still)
    full = joined([standing, room])
    extent = np.array(ground.grid.shape[:2]) * ground.spacing_m
    shape = (int(extent[0] / CELL_M) + 1, int(extent[1] / CELL_M) + 1)
    layout = np.array([*ground.low, ground.spacing_m, CELL_M, ground.steepest])
    cells, items = cells_of(standing, layout, shape)
    tops = np.full(shape[0] * shape[1], -np.inf)
    np.maximum.at(tops, cells, bounds(standing)[items, 5])
    order = np.argsort(cells, kind="stable")
    starts = np.searchsorted(cells[order], np.arange(shape[0] * shape[1] + 1))
    heads = np.full(shape, -1, np.int64)
    nodes = np.zeros((MAX_NODES, 2), np.int64)
    arrays = SceneArrays(
        ground.grid,
        layout,
        full.kinds,
        full.parameters,
        full.materials,
        full.edges,
        starts,
        items[order],
        tops,
        heads,
        nodes,
    )
    return Scene(arrays, len(standing))


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
    given = scene.arrays, Beams(directions, numbers), T_town_lidar, np.uint64(key)
    workers = config.NUMBA_NUM_THREADS  # type: ignore[attr-defined]
    parts = pairwise(np.linspace(0, len(directions), 4 * workers + 1).astype(np.int64))
    with ThreadPoolExecutor(workers) as threads:
        list(threads.map(lambda part: cast(*given, *part, out), parts))
    seen = np.isfinite(out[:, 0])
    out = out[seen]
    points = directions[seen] * out[:, :1]
    intensities, labels = out[:, 1].astype(np.float32), out[:, 2].astype(np.uint8)
    return SimulatedScan(points, intensities, labels, out[:, 3].astype(np.int64))

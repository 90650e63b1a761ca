"""A made-up street corner, on which everything that is compiled runs once before the first scan.

The first run on a machine compiles for a minute or two; what is compiled is kept beside the
package, or where ``NUMBA_CACHE_DIR`` says.
"""

import numpy as np

from sl3d_slam.config import SlamConfig
from sl3d_slam.geometry.se3 import Points
from sl3d_slam.lines.extract import LineExtractor
from sl3d_slam.lines.grown import grow_uprights
from sl3d_slam.lines.scene import make_scene
from sl3d_slam.loops.constellations import ConstellationIndex
from sl3d_slam.matching.views import pack, to_bytes
from sl3d_slam.verifying import Candidates, verify
from sl3d_slam.viewing import view_of

SENSOR_HEIGHT_M = 1.8
SPACING_M = 0.2


def rehearse_keyframes(extractor: LineExtractor, config: SlamConfig) -> None:
    """Make a view and verify a loop between it and itself, whatever the weights call a line."""
    points_lidar = street_corner()
    _grow_lines(points_lidar, config)
    packed = to_bytes(pack(view_of(points_lidar, extractor, config)))
    verify(Candidates(1, [(0, (0.0, 0.0, 0.0))], None, {0: packed, 1: packed}), config)


def rehearse_constellations() -> None:
    """Recognise a constellation."""
    index, xy = ConstellationIndex(), _poles_xy()
    weights = np.ones(len(xy))
    index.add(0, xy, weights)
    index.query(xy, weights, 0, 1)


def _grow_lines(points_lidar: Points, config: SlamConfig) -> None:
    """Grow lines as after a network that is sure of all that stands: poles, walls, a corner."""
    scene = make_scene(points_lidar, config.lines)
    points = np.column_stack([scene.points, scene.heights]).astype(np.float32)
    sure = np.ones(len(points), np.float32)
    grow_uprights(scene, points, sure, config.lines.min_length_m)


def street_corner() -> Points:
    """Return (N, 3) metres, lidar frame: a street, a house at each side of it, eight poles."""
    along, beside = np.arange(-20.0, 20.0, SPACING_M), np.arange(9.0, 15.0, SPACING_M)
    ground = np.stack(np.meshgrid(along, along, [0.0]), axis=-1).reshape(-1, 3)
    fronts = [np.column_stack([along, np.full(len(along), y)]) for y in (-9.0, 9.0)]
    sides = [np.column_stack([np.full(len(beside), 20.0), y]) for y in (-beside, beside)]
    walls = [_standing(plan, np.arange(0.0, 5.0, SPACING_M)) for plan in (*fronts, *sides)]
    turn = np.linspace(0.0, np.pi, 5)
    rim = 0.1 * np.column_stack([np.cos(turn), np.sin(turn)])
    poles = [_standing(pole + rim, np.arange(0.0, 4.0, 0.1)) for pole in _poles_xy()]
    return np.concatenate([ground, *walls, *poles]) - [0.0, 0.0, SENSOR_HEIGHT_M]


def _poles_xy() -> np.ndarray:
    return np.array([[x, y] for x in (-13.0, -4.0, 5.0, 15.0) for y in (-6.0, 5.0)])


def _standing(plan: np.ndarray, height: np.ndarray) -> Points:
    """Raise every point of a plan (N, 2) to every height."""
    return np.column_stack([np.repeat(plan, len(height), axis=0), np.tile(height, len(plan))])

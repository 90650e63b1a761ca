"""Lines of one scan from geometry alone."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from sl3d_slam.config import LineSettings
from sl3d_slam.geometry.se3 import Points, make_transform
from sl3d_slam.geometry.segments import transform_segments
from sl3d_slam.lines.describe import describe_uprights
from sl3d_slam.lines.edges import find_edges
from sl3d_slam.lines.poles import Upright, find_poles
from sl3d_slam.lines.scene import Scene, make_scene
from sl3d_slam.types import LineKind, LineSet


class Proposal(NamedTuple):
    """What geometry proposes in a scan: uprights of its scene (level frame) and their kinds."""

    scene: Scene
    uprights: list[Upright]
    kinds: list[LineKind]


def propose(points_lidar: Points, settings: LineSettings) -> Proposal:
    """Find the poles, then the standing edges, of a scan."""
    scene = make_scene(points_lidar, settings)
    return Proposal(scene, *find_uprights(scene, settings))


def geometric_lines(proposal: Proposal, settings: LineSettings) -> LineSet:
    """Return what is proposed as lines with hand-made descriptors, best score first."""
    scene, uprights, kinds = proposal
    order = sorted(range(len(uprights)), key=lambda i: -uprights[i].score)[: settings.max_lines]
    endpoints = np.array([uprights[i].endpoints for i in order]).reshape(-1, 2, 3)
    measures = np.array(
        [
            (u.bottom_m, u.top_m, u.thickness_m, float(kind == LineKind.VERTICAL_EDGE))
            for u, kind in ((uprights[i], kinds[i]) for i in order)
        ]
    ).reshape(-1, 4)
    places = endpoints[:, :, :2].mean(axis=1)
    return LineSet(
        endpoints=to_lidar(scene, endpoints),
        descriptors=describe_uprights(places, measures, scene.points, scene.heights),
        num_points=np.array([uprights[i].num_points for i in order], np.int64),
        kinds=np.array([kinds[i] for i in order], np.uint8),
        scores=np.array([uprights[i].score for i in order], np.float32),
        up=scene.up,
        ground_up=scene.ground_up,
    )


def find_uprights(scene: Scene, settings: LineSettings) -> tuple[list[Upright], list[LineKind]]:
    """Return the poles, then the standing edges, of a scene and which is which."""
    poles = find_poles(scene, settings.min_length_m)
    edges = find_edges(scene, settings.grow_radius_m, settings.min_length_m)
    kinds = [LineKind.POLE] * len(poles) + [LineKind.VERTICAL_EDGE] * len(edges)
    return [*poles, *edges], kinds


def to_lidar(
    scene: Scene, endpoints_level: Float64[np.ndarray, "L 2 3"]
) -> Float64[np.ndarray, "L 2 3"]:
    """Express segments of the level frame in the lidar frame."""
    return transform_segments(make_transform(scene.R_level_lidar.T, np.zeros(3)), endpoints_level)

"""Lines of one scan: the geometric extractor."""

import numpy as np
from jaxtyping import Float64

from sl3d_slam.config import LineSettings
from sl3d_slam.errors import InputError, MissingExtraError
from sl3d_slam.geometry.se3 import make_transform
from sl3d_slam.geometry.segments import transform_segments
from sl3d_slam.types import LineKind, LineSet

MIN_POINTS = 50


class LineExtractor:
    """Finds standing poles and building edges in one scan, from geometry alone.

    Deterministic, and tied to no sensor: only the coordinates count, not their order. Poles, posts
    and trunks are narrow columns with free space around (LineKind.POLE; the line is the axis
    behind the visible front). Standing edges are where two walls meet or one truly ends
    (LineKind.VERTICAL_EDGE); ends in the shadow of something nearer are left out. "Standing" is
    meant against the ground around the sensor, which may be tilted by up to 25 degrees.
    """

    def __init__(self, settings: LineSettings = LineSettings()) -> None:  # noqa: B008  (frozen)
        self._settings = settings

    @classmethod
    def pretrained(cls, device: str = "cpu") -> "LineExtractor":
        """Refuse: this version ships no trained network; ``LineExtractor()`` is the geometric one.

        A geometric extractor under this name would be taken for the learned one, in results too.
        """
        raise MissingExtraError(
            "no trained line network ships with this version; "
            f"LineExtractor() finds lines geometrically (asked for a network on {device})"
        )

    def extract(self, points_lidar: np.ndarray) -> LineSet:
        """Return the lines of a scan (N, 3) in metres, in the lidar frame, best score first.

        Descriptors (L, 28) hold the line's height above ground, thickness and kind and what stands
        around it, see :func:`sl3d_slam.lines.describe.describe_uprights`. A scan without structure
        gives an empty set. A sweep of a moving sensor should be deskewed before: at 10 m/s lines
        of raw sweeps disagree by twice as much.

        Raises
        ------
        InputError
            where the array is no (N, 3) of finite floats or has fewer than 50 points.
        """
        from sl3d_slam.lines.describe import describe_uprights
        from sl3d_slam.lines.edges import find_edges
        from sl3d_slam.lines.poles import find_poles
        from sl3d_slam.lines.scene import make_scene

        scene = make_scene(checked_points(points_lidar), self._settings)
        poles = find_poles(scene, self._settings.min_length_m)
        edges = find_edges(scene, self._settings.grow_radius_m, self._settings.min_length_m)
        uprights = [*poles, *edges]
        kinds = [LineKind.POLE] * len(poles) + [LineKind.VERTICAL_EDGE] * len(edges)
        order = sorted(range(len(uprights)), key=lambda i: -uprights[i].score)
        order = order[: self._settings.max_lines]
        endpoints = np.array([uprights[i].endpoints for i in order]).reshape(-1, 2, 3)
        measures = np.array(
            [
                (u.bottom_m, u.top_m, u.thickness_m, float(kind == LineKind.VERTICAL_EDGE))
                for u, kind in ((uprights[i], kinds[i]) for i in order)
            ]
        ).reshape(-1, 4)
        places = endpoints[:, :, :2].mean(axis=1)
        return LineSet(
            endpoints=transform_segments(
                make_transform(scene.R_level_lidar.T, np.zeros(3)), endpoints
            ),
            descriptors=describe_uprights(places, measures, scene.points, scene.heights),
            num_points=np.array([uprights[i].num_points for i in order], np.int64),
            kinds=np.array([kinds[i] for i in order], np.uint8),
            scores=np.array([uprights[i].score for i in order], np.float32),
        )


def checked_points(points_lidar: np.ndarray) -> Float64[np.ndarray, "N 3"]:
    """Return the points as float64, or say what is wrong with them."""
    points = np.asarray(points_lidar)
    if points.ndim != 2 or points.shape[1] != 3 or not np.issubdtype(points.dtype, np.floating):
        raise InputError(
            f"points_lidar: expected a float array (N, 3), found {points.dtype} {points.shape}"
        )
    if len(points) < MIN_POINTS:
        raise InputError(f"points_lidar: {len(points)} points; a scan has at least {MIN_POINTS}")
    if not np.isfinite(points).all():
        raise InputError("points_lidar: NaN or infinite coordinates; drop those points first")
    return np.ascontiguousarray(points, dtype=np.float64)

"""What of a cloud its beams can have seen, and what only seems to be a surface."""

import numpy as np
import small_gicp
from jaxtyping import Bool

from sl3d_slam.geometry.se3 import Points

FAR_M = 20.0  # from where on rings can be farther apart than points
LEAST_FACING = 0.03  # sine of the angle at which a beam meets a surface: 2 deg


def faces_its_beam(points_lidar: Points, num_neighbours: int) -> Bool[np.ndarray, "N"]:
    """Tell which points do not lie on a surface edge-on to their beam; near ones all pass.

    Far away, where the rings of a scan are farther apart than its points, all neighbours of a point
    lie on its own ring, and the surface they seem to span is the one that the beams sweep: a ring
    across a wall passes for a floor. A lidar cannot see such a floor, but it would hold roll and
    pitch.
    """
    ranges_m = np.linalg.norm(points_lidar, axis=1)
    faces = ranges_m < FAR_M
    far_m, far_points = ranges_m[~faces], points_lidar[~faces]
    far = small_gicp.PointCloud(far_points)
    if far.size() > 0:
        tree = small_gicp.KdTree(far, num_threads=1)
        small_gicp.estimate_normals(far, tree, num_neighbors=num_neighbours, num_threads=1)
        into_surface_m = np.abs(np.einsum("ij,ij->i", far_points, far.normals()[:, :3]))
        faces[~faces] = into_surface_m > LEAST_FACING * far_m
    return faces

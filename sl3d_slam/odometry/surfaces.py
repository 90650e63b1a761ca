"""The surfaces of a scan that odometry aligns to those of the scans before it.

small_gicp's second thread waits by spinning, which costs more than it gains beside other work: one
is used.
"""

import small_gicp

from sl3d_slam.geometry.facing import faces_its_beam
from sl3d_slam.geometry.gaussian_voxels import Surfaces
from sl3d_slam.geometry.se3 import Points

SAMPLING_M = 0.5
NEIGHBOURS = 10


def surfaces_of(points_lidar: Points) -> Surfaces:
    """Sample a scan to half a metre, each point with the normal of its surroundings.

    Left out is what a beam meets edge-on. With an HDL-32E these few (a point in
    sixteen) had a third to a half of the say, and roll and pitch erred by up to three times as
    much as without them.
    """
    sampled = small_gicp.voxelgrid_sampling(points_lidar, SAMPLING_M, num_threads=1)
    points = sampled.points()[:, :3]
    cloud = small_gicp.PointCloud(points[faces_its_beam(points, NEIGHBOURS)])
    if cloud.size() > 0:
        tree = small_gicp.KdTree(cloud, num_threads=1)
        small_gicp.estimate_normals(cloud, tree, num_neighbors=NEIGHBOURS, num_threads=1)
    return Surfaces.of(cloud)

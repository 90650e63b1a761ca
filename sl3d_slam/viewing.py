"""What loops need of a scan: its lines, the way up and a coarse cloud."""

from sl3d_slam.config import SlamConfig
from sl3d_slam.geometry.se3 import Points
from sl3d_slam.lines.extract import LineExtractor
from sl3d_slam.matching.views import make_view
from sl3d_slam.types import View


def view_of(points_lidar: Points, extractor: LineExtractor, config: SlamConfig) -> View:
    """Extract what loops need from a scan."""
    lines = extractor.extract(points_lidar)
    return make_view(points_lidar, lines, config.matching.cloud_voxel_m)

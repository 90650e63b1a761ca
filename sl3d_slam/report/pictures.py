"""All pictures of a run; each function returns the bytes of a PNG file and writes nothing."""

from sl3d_slam.report.map_pictures import draw_map, draw_relocalization
from sl3d_slam.report.scan_pictures import draw_lines, draw_registration
from sl3d_slam.report.trajectory import draw_trajectory

__all__ = [
    "draw_lines",
    "draw_map",
    "draw_registration",
    "draw_relocalization",
    "draw_trajectory",
]

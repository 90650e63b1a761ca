"""LiDAR SLAM front end for GTSAM: odometry, 3D lines, loops, relocalization in a line map.

The names below are imported when first used, so that ``import sl3d_slam`` stays light.
"""

from importlib import import_module
from typing import Any

__version__ = "0.1.0"

_HOMES = {
    "LineExtractor": "sl3d_slam.lines.extract",
    "LineSet": "sl3d_slam.types",
    "register_lines": "sl3d_slam.registration",
    "LineMap": "sl3d_slam.mapping.line_map",
    "Relocalizer": "sl3d_slam.relocalization.relocalizer",
    "LineLoopFrontend": "sl3d_slam.frontend",
    "SlamPipeline": "sl3d_slam.pipeline",
    "load_config": "sl3d_slam.config",
}
__all__ = sorted(_HOMES)


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'sl3d_slam' has no attribute '{name}'")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]

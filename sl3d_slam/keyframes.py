"""RegisteredScan* -> Keyframe: a scan is kept once the sensor moved or turned enough."""

import numpy as np

from sl3d_slam.config import KeyframeSettings
from sl3d_slam.geometry.se3 import Transform, distance_m, invert, rotation_angle_rad
from sl3d_slam.types import Keyframe, RegisteredScan


def starts_keyframe(
    T_odom_last: Transform, T_odom_lidar: Transform, settings: KeyframeSettings
) -> bool:
    """Tell whether the sensor moved or turned enough since the last keyframe."""
    T_last_lidar = invert(T_odom_last) @ T_odom_lidar
    rotation_deg = float(np.degrees(rotation_angle_rad(T_last_lidar)))
    return (
        distance_m(T_last_lidar) >= settings.min_distance_m
        or rotation_deg >= settings.min_rotation_deg
    )


class KeyframeSelector:
    """Numbers the scans that become keyframes, from 0; the first scan always is one."""

    def __init__(self, settings: KeyframeSettings) -> None:
        self._settings = settings
        self._T_odom_last: Transform | None = None
        self._next_id = 0

    def add(self, scan: RegisteredScan) -> Keyframe | None:
        """Return the scan as a keyframe, or None where it is too close to the last one."""
        if self._T_odom_last is not None and not starts_keyframe(
            self._T_odom_last, scan.T_odom_lidar, self._settings
        ):
            return None
        keyframe = Keyframe(
            id=self._next_id,
            scan_index=scan.index,
            stamp_s=scan.stamp_s,
            points_lidar=scan.points_lidar,
            T_odom_lidar=scan.T_odom_lidar,
        )
        self._next_id += 1
        self._T_odom_last = scan.T_odom_lidar
        return keyframe

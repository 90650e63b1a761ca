"""Where is one scan in another? No first guess: python examples/03_close_a_loop.py

Two scans of a simulated drive, 10 m and a lap apart, the newer with the sensor turned by 150
degrees.
"""

import numpy as np

from sl3d_slam import LineExtractor, register_lines
from sl3d_slam.geometry.se3 import (
    distance_m,
    from_yaw,
    invert,
    rotation_angle_rad,
    transform_points,
)
from sl3d_slam.simulation.drive import plan_drive, simulate_drive
from sl3d_slam.simulation.roads import builtin_road
from sl3d_slam.simulation.town import build_town


def main() -> None:
    drive = plan_drive(build_town(builtin_road("demo"), seed=3))
    older, newer = simulate_drive(drive, [10, 205])
    T_turned_lidar = from_yaw(np.radians(150.0), np.zeros(3))
    target = older.points_lidar
    source = transform_points(T_turned_lidar, newer.points_lidar)

    extractor = LineExtractor()
    result = register_lines(
        extractor.extract(source), extractor.extract(target), clouds=(source, target)
    )

    if result.T_target_source is None:
        raise SystemExit(f"not registered: {result.reason}")
    T_world_source = drive.T_town_lidar[205] @ invert(T_turned_lidar)
    T_target_source = invert(drive.T_town_lidar[10]) @ T_world_source
    error = invert(T_target_source) @ result.T_target_source
    print(f"{result.num_inliers} lines agree; T_target_source:")
    print(np.array2string(result.T_target_source, precision=3, suppress_small=True))
    print(f"one sigma: {sigmas(result.information)}")
    print(f"off by {distance_m(error):.3f} m and {np.degrees(rotation_angle_rad(error)):.2f} deg")


def sigmas(information: np.ndarray) -> str:
    """Read an information matrix: rotation first, as in GTSAM, at the source scan."""
    sigma = np.sqrt(np.diag(np.linalg.inv(information)))
    return f"{np.degrees(sigma[:3]).round(3)} deg, {sigma[3:].round(3)} m"


if __name__ == "__main__":
    main()

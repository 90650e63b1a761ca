"""Save a map, come back another day, and ask where you are from one scan, with no first guess.

Run it: ``python examples/05_relocalize.py`` (simulated data, no download).
"""

import tempfile
from pathlib import Path

import numpy as np

from sl3d_slam import LineMap, Relocalizer, SlamPipeline, load_config
from sl3d_slam.geometry.se3 import distance_m, from_yaw, invert, transform_points
from sl3d_slam.simulation.drive import plan_drive, simulate_drive
from sl3d_slam.simulation.roads import builtin_road
from sl3d_slam.simulation.town import build_town

NUM_SCANS = 60


def main() -> None:
    """Map the first scans of a drive, then find scans of another day in the saved file."""
    town = build_town(builtin_road("demo"), seed=5)
    slam = SlamPipeline(load_config(), simulated=True)
    for scan in simulate_drive(plan_drive(town, scans=NUM_SCANS)):
        slam.process_scan(scan.points_lidar)
    path = Path(tempfile.mkdtemp()) / "map.sl3d"
    slam.finish().line_map.save(path)

    relocalizer = Relocalizer(LineMap.load(path))
    another_day = plan_drive(town, day=1)
    chosen = [10, 30, 50]
    for index, scan in zip(chosen, simulate_drive(another_day, chosen), strict=True):
        T_turned_lidar = from_yaw(2.4, np.zeros(3))  # the sensor looks elsewhere
        answer = relocalizer.relocalize(transform_points(T_turned_lidar, scan.points_lidar))
        if not answer.success:
            print(f"scan {index}: not found, {answer.reason}")
            continue
        T_map_true = another_day.T_town_lidar[index] @ invert(T_turned_lidar)
        error_m = distance_m(invert(T_map_true) @ answer.T_map_lidar)
        print(
            f"scan {index}: found with confidence {answer.confidence:.2f}, off by {error_m:.2f} m"
        )


if __name__ == "__main__":
    main()

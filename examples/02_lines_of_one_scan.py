"""Find the lines of one scan: python examples/02_lines_of_one_scan.py [SCAN]

SCAN is a .bin, .pcd or .ply file. Without one, a scan of a simulated town is cast.
"""

import sys
from pathlib import Path

import numpy as np

from sl3d_slam import LineExtractor, load_config
from sl3d_slam.io.open import read_scan
from sl3d_slam.simulation.drive import plan_drive, simulate_drive
from sl3d_slam.simulation.roads import builtin_road
from sl3d_slam.simulation.town import build_town
from sl3d_slam.types import LineKind


def simulated_scan() -> np.ndarray:
    drive = plan_drive(build_town(builtin_road("street"), seed=1))
    return next(simulate_drive(drive, [40])).points_lidar


def main() -> None:
    if len(sys.argv) > 1:
        points_lidar = read_scan(Path(sys.argv[1]), load_config().input)
    else:
        points_lidar = simulated_scan()

    lines = LineExtractor().extract(points_lidar)

    print(f"{len(lines)} lines in {len(points_lidar)} points; the best ten:")
    for i in range(min(10, len(lines))):
        first, last = lines.endpoints[i]
        x, y, _ = 0.5 * (first + last)
        length_m = np.linalg.norm(last - first)
        kind = LineKind(lines.kinds[i]).name.lower().replace("_", " ")
        print(f"  {kind:13} {length_m:4.1f} m tall, {x:6.1f} m ahead, {y:6.1f} m to the left")


if __name__ == "__main__":
    main()

"""Map a folder of scans: python examples/01_map_a_folder.py [FOLDER [OUT]]

FOLDER is a KITTI sequence, a folder of .bin, .pcd or .ply scans, or a bag. Without one, 60 scans of
a simulated street are written to a temporary folder and mapped from there.
"""

import sys
import tempfile
from pathlib import Path

from sl3d_slam import SlamPipeline, load_config
from sl3d_slam.io.open import open_dataset
from sl3d_slam.simulation.drive import plan_drive
from sl3d_slam.simulation.roads import builtin_road
from sl3d_slam.simulation.town import build_town
from sl3d_slam.simulation.write import Layout, write_drive


def simulated_folder(root: Path) -> Path:
    town = build_town(builtin_road("street"), seed=1)
    write_drive(plan_drive(town, sensor="hdl32", scans=60), Layout(root, truth=False))
    return root


def main() -> None:
    scratch = Path(tempfile.mkdtemp(prefix="sl3d_example_"))
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else simulated_folder(scratch / "data")
    out = Path(sys.argv[2]) if len(sys.argv) > 2 else scratch / "run"

    config = load_config(overrides=["keyframes.min_distance_m=4.0"])
    dataset = open_dataset(folder, config.input)
    slam = SlamPipeline(config, simulated=dataset.simulated)
    for scan in dataset:
        slam.process(scan)
    run = slam.finish()
    figures = run.save(out, dataset)

    print(f"{figures['num_scans']} scans, {figures['length_m']:.0f} m, {dataset.description}")
    print(f"{figures['loops_accepted']} loops, {figures['num_lines']} lines in the map")
    if "ate_rmse_m" in figures:
        print(f"trajectory off by {figures['ate_rmse_m']:.3f} m (RMS)")
    print(f"written to {out}: {', '.join(sorted(path.name for path in out.iterdir()))}")


if __name__ == "__main__":
    main()

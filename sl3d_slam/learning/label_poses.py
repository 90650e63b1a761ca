"""Where the scans of a drive to label were taken."""

from pathlib import Path

import numpy as np
from jaxtyping import Float64

from sl3d_slam.config import InputSettings, OdometrySettings
from sl3d_slam.files import write_whole
from sl3d_slam.io.dataset import Dataset
from sl3d_slam.io.open import open_dataset
from sl3d_slam.io.text_table import read_table
from sl3d_slam.learning.labelling import Source
from sl3d_slam.odometry.odometry import Odometry


def drive_poses(
    source: Source, dataset: Dataset, count: int, out: Path
) -> Float64[np.ndarray, "S 4 4"]:
    """Return true poses of a simulated drive, else odometry's, kept in ``T_world_lidar.txt``."""
    if dataset.simulated and dataset.truth is not None:
        return dataset.truth
    path = out / "T_world_lidar.txt"
    rows = (
        read_table(path, 12, "the odometry of this drive") if path.is_file() else np.zeros((0, 12))
    )
    if len(rows) < count:
        settings = InputSettings()
        drive = open_dataset(Path(source.data), settings, source.dataset, source.sequence)
        odometry = Odometry(OdometrySettings(), settings)
        poses = [odometry.register(scan).T_odom_lidar for scan in drive.iterate(0, count)]
        rows = np.array(poses)[:, :3].reshape(-1, 12)
        write_whole(path, "".join(" ".join(f"{v:.9f}" for v in row) + "\n" for row in rows))
    bottom = np.broadcast_to([0.0, 0.0, 0.0, 1.0], (len(rows), 1, 4))
    return np.concatenate([rows.reshape(-1, 3, 4), bottom], axis=1)

"""Trajectories as text: TUM (stamp, position, quaternion xyzw) and KITTI (rows of 3 x 4)."""

from pathlib import Path

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from sl3d_slam.errors import InputError
from sl3d_slam.files import write_whole
from sl3d_slam.io.text_table import read_table
from sl3d_slam.types import Trajectory

Transforms = Float64[np.ndarray, "N 4 4"]


def write_tum(path: Path, trajectory: Trajectory) -> None:
    """Write one row ``stamp tx ty tz qx qy qz qw`` a pose, digits enough to read it back exactly.

    The quaternion is the one with ``qw >= 0``. Raises OutputError.
    """
    poses = trajectory.T_world_lidar
    quats_xyzw = Rotation.from_matrix(poses[:, :3, :3]).as_quat(canonical=True)
    write_whole(path, _rows(np.column_stack([trajectory.stamps_s, poses[:, :3, 3], quats_xyzw])))


def read_tum(path: Path) -> Trajectory:
    """Read what :func:`write_tum` writes; quaternions are normalised. Raises InputError."""
    table = read_table(path, 8, "TUM rows 'stamp tx ty tz qx qy qz qw'")
    norms = np.linalg.norm(table[:, 4:], axis=1)
    if np.any(np.abs(norms - 1.0) > 0.01):
        raise InputError(
            f"{path}: row {int(np.argmax(np.abs(norms - 1.0)))} has no unit quaternion"
        )
    poses = np.tile(np.eye(4), (len(table), 1, 1))
    poses[:, :3, :3] = Rotation.from_quat(table[:, 4:]).as_matrix()
    poses[:, :3, 3] = table[:, 1:4]
    return Trajectory(table[:, 0].copy(), poses)


def write_kitti_poses(path: Path, T_world_frame: Transforms) -> None:
    """Write the first three rows of each matrix as 12 numbers a line. Raises OutputError."""
    write_whole(path, _rows(T_world_frame[:, :3, :].reshape(-1, 12)))


def read_kitti_poses(path: Path) -> Transforms:
    """Read rows of 12 numbers; rotations are brought to the nearest rotation matrix.

    Raises
    ------
    InputError
        naming the file and the row that is no rigid transform.
    """
    table = read_table(path, 12, "KITTI poses, 12 numbers a row")
    poses = np.tile(np.eye(4), (len(table), 1, 1))
    poses[:, :3, :] = table.reshape(-1, 3, 4)
    left, _, right = np.linalg.svd(poses[:, :3, :3])
    nearest = left @ right
    errors = np.abs(nearest - poses[:, :3, :3]).max(axis=(1, 2))
    improper = (errors > 0.01) | (np.linalg.det(nearest) < 0)
    if improper.any():
        raise InputError(
            f"{path}: row {int(np.argmax(improper))} is no rigid transform; expected KITTI poses"
        )
    poses[:, :3, :3] = nearest
    return poses


def to_camera_frame(
    T_world_lidar: Transforms, T_cam_lidar: Float64[np.ndarray, "4 4"]
) -> Transforms:
    """Express lidar poses as KITTI does: ``T_camworld_cam = Tr T_world_lidar Tr^-1``."""
    return T_cam_lidar @ T_world_lidar @ np.linalg.inv(T_cam_lidar)


def to_lidar_frame(T_world_cam: Transforms, T_cam_lidar: Float64[np.ndarray, "4 4"]) -> Transforms:
    """Undo :func:`to_camera_frame`: ``T_world_lidar = Tr^-1 T_camworld_cam Tr``."""
    return np.linalg.inv(T_cam_lidar) @ T_world_cam @ T_cam_lidar


def _rows(table: Float64[np.ndarray, "N C"]) -> str:
    """Print each number with the fewest digits that read back to the same float64."""
    return "".join(" ".join(repr(float(x)) for x in row) + "\n" for row in table)

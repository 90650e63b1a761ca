import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sl3d_slam.errors import InputError
from sl3d_slam.io.trajectory import (
    read_kitti_poses,
    read_tum,
    to_camera_frame,
    to_lidar_frame,
    write_kitti_poses,
    write_tum,
)
from sl3d_slam.types import Trajectory


def random_poses(count, seed):
    rng = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Rotation.random(count, random_state=rng).as_matrix()
    poses[:, :3, 3] = rng.normal(scale=500.0, size=(count, 3))
    return poses


def test_tum_golden_row(tmp_path):
    quarter_turn_left = np.array([[0.0, -1, 0, 1.5], [1, 0, 0, -2], [0, 0, 1, 0.25], [0, 0, 0, 1]])
    write_tum(tmp_path / "t.txt", Trajectory(np.array([1.5e9 + 0.125]), quarter_turn_left[None]))
    words = (tmp_path / "t.txt").read_text().split()
    assert words[:6] == ["1500000000.125", "1.5", "-2.0", "0.25", "0.0", "0.0"]
    half = np.sqrt(0.5)  # sin and cos of half of 90 degrees: z, then w
    np.testing.assert_allclose([float(w) for w in words[6:]], [half, half], rtol=1e-15)


def test_tum_round_trip(tmp_path):
    stamps = 1.7e9 + np.sort(np.random.default_rng(1).uniform(0, 100, 50))
    trajectory = Trajectory(stamps, random_poses(50, 2))
    write_tum(tmp_path / "t.txt", trajectory)
    back = read_tum(tmp_path / "t.txt")
    assert np.array_equal(back.stamps_s, stamps)
    assert np.array_equal(back.T_world_lidar[:, :3, 3], trajectory.T_world_lidar[:, :3, 3])
    # the rotation goes through a quaternion: a few units in the last place
    np.testing.assert_allclose(back.T_world_lidar, trajectory.T_world_lidar, rtol=0, atol=2e-15)


def test_kitti_golden_bytes_and_round_trip(tmp_path):
    pose = np.array([[0.0, -1, 0, 1.5], [1, 0, 0, -2], [0, 0, 1, 0.1], [0, 0, 0, 1]])
    write_kitti_poses(tmp_path / "k.txt", pose[None])
    assert (tmp_path / "k.txt").read_bytes() == (
        b"0.0 -1.0 0.0 1.5 1.0 0.0 0.0 -2.0 0.0 0.0 1.0 0.1\n"
    )
    poses = random_poses(40, 3)
    write_kitti_poses(tmp_path / "k.txt", poses)
    # the nearest rotation of a rotation is itself up to rounding
    np.testing.assert_allclose(read_kitti_poses(tmp_path / "k.txt"), poses, rtol=0, atol=1e-14)


def test_camera_and_lidar_frames_by_following_a_point():
    T_cam_lidar = random_poses(1, 4)[0]
    T_world_cam = random_poses(5, 5)
    T_world_cam[0] = np.eye(4)
    found = to_lidar_frame(T_world_cam, T_cam_lidar)
    point_lidar = np.array([3.0, -2.0, 0.7, 1.0])
    for i in range(5):
        # the same point, moved into the camera, then into the camera's world; and that world
        # seen from where the lidar was at the start
        in_camera_world = T_world_cam[i] @ (T_cam_lidar @ point_lidar)
        expected = np.linalg.solve(T_cam_lidar, in_camera_world)
        np.testing.assert_allclose(found[i] @ point_lidar, expected, atol=1e-9)
    np.testing.assert_allclose(to_camera_frame(found, T_cam_lidar), T_world_cam, atol=1e-9)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("", "holds no numbers"),
        ("1 0 0 0 0 1 0 0 0 0 1\n", "line 1 is not 12"),
        ("1 0 0 0 0 1 0 0 0 0 1 0\n\n1 0 0 0 0 1 0 0 0 0 1 nan\n", "line 3 is not 12 finite"),
        ("1 0 0 0 0 1 0 0 0 0 one 0\n", "line 1"),
        ("2 0 0 0 0 2 0 0 0 0 2 0\n", "row 0 is no rigid transform"),
        ("-1 0 0 0 0 1 0 0 0 0 1 0\n", "row 0 is no rigid transform"),  # a mirror image
    ],
)
def test_damaged_kitti_poses_are_named(tmp_path, text, complaint):
    path = tmp_path / "07.txt"
    path.write_text(text)
    with pytest.raises(InputError, match=rf"07\.txt: .*{complaint}"):
        read_kitti_poses(path)


def test_damaged_tum_files_are_named(tmp_path):
    path = tmp_path / "tum.txt"
    for text, complaint in [
        ("0 0 0 0 0 0 0 2\n", "row 0 has no unit quaternion"),
        ("0 0 0 0 0 0 1\n", "line 1"),
    ]:
        path.write_text(text)
        with pytest.raises(InputError, match=rf"tum\.txt: .*{complaint}"):
            read_tum(path)
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match=r"tum\.txt: is not text"):
        read_tum(path)
    with pytest.raises(InputError, match=r"absent\.txt: not found"):
        read_tum(tmp_path / "absent.txt")


def test_comments_and_blank_lines_are_skipped(tmp_path):
    (tmp_path / "t.txt").write_text("# stamp x y z qx qy qz qw\n\n3 1 2 3 0 0 0 1 # here\n")
    assert read_tum(tmp_path / "t.txt").stamps_s.tolist() == [3.0]

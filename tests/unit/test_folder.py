import numpy as np
import pytest

from sl3d_slam.config import InputSettings
from sl3d_slam.errors import InputError
from sl3d_slam.io.open import open_dataset
from sl3d_slam.io.scan_file import natural_key

SETTINGS = InputSettings(min_range_m=1.0, max_range_m=80.0)


def write_scan(path, first_x):
    points = np.full((150, 4), 4.0, "<f4")
    points[:, 0] = first_x
    path.write_bytes(points.tobytes())


def test_natural_order(tmp_path):
    names = ["scan2.bin", "scan10.bin", "scan1.bin", "a10b2.bin", "a10b11.bin", "a9b3.bin"]
    ordered = sorted((tmp_path / name for name in names), key=natural_key)
    assert [p.name for p in ordered] == [
        "a9b3.bin", "a10b2.bin", "a10b11.bin", "scan1.bin", "scan2.bin", "scan10.bin",
    ]  # fmt: skip


def test_names_of_numbers_and_letters_can_be_ordered_together(tmp_path):
    names = ["7.bin", "x.bin", "007.bin", "10.bin", "x7.bin", "²3.bin"]
    ordered = sorted((tmp_path / name for name in names), key=natural_key)
    assert [p.name for p in ordered[:3]] == ["007.bin", "7.bin", "10.bin"]


def test_folder_of_scans_in_natural_order(tmp_path):
    for number in (1, 2, 10):
        write_scan(tmp_path / f"scan{number}.bin", number)
    (tmp_path / "notes.md").write_text("not a scan")
    write_scan(tmp_path / ".hidden.bin", 99)
    dataset = open_dataset(tmp_path, SETTINGS)
    assert len(dataset) == 3
    assert [scan.points_lidar[0, 0] for scan in dataset] == [1.0, 2.0, 10.0]
    assert [scan.stamp_s for scan in dataset] == [0.0, 0.1, 0.2]
    assert "times.txt" in dataset.warnings[0]
    assert dataset.truth is None
    assert dataset.T_cam_lidar is None


def test_elevation_is_left_alone_unless_asked_for(tmp_path):
    write_scan(tmp_path / "0.bin", 3.0)
    forced = SETTINGS.model_copy(update={"kitti_correction": "on"})
    assert next(iter(open_dataset(tmp_path, SETTINGS))).points_lidar[0].tolist() == [3.0, 4.0, 4.0]
    assert next(iter(open_dataset(tmp_path, forced))).points_lidar[0, 2] > 4.0


def test_times_beside_the_scans_are_used(tmp_path):
    for number in (0, 1):
        write_scan(tmp_path / f"{number}.bin", 2.0)
    (tmp_path / "times.txt").write_text("5.0\n5.25\n")
    assert [scan.stamp_s for scan in open_dataset(tmp_path, SETTINGS)] == [5.0, 5.25]


def test_mixed_kinds_are_refused(tmp_path):
    write_scan(tmp_path / "0.bin", 2.0)
    (tmp_path / "1.ply").write_text("ply")
    with pytest.raises(InputError, match="several kinds"):
        open_dataset(tmp_path, SETTINGS)


def test_options_of_other_datasets_are_refused(tmp_path):
    write_scan(tmp_path / "0.bin", 2.0)
    with pytest.raises(InputError, match="--sequence"):
        open_dataset(tmp_path, SETTINGS, sequence="00")
    with pytest.raises(InputError, match="topic"):
        open_dataset(tmp_path, SETTINGS, topic="/points")
    with pytest.raises(InputError, match=r"0\.bin: is not a dataset"):
        open_dataset(tmp_path / "0.bin", SETTINGS)

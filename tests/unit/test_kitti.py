import gc
import weakref
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sl3d_slam.config import InputSettings
from sl3d_slam.errors import InputError
from sl3d_slam.io.open import open_dataset, read_scan
from sl3d_slam.io.points import raise_elevation

SETTINGS = InputSettings(min_range_m=1.0, max_range_m=80.0)
OFF = InputSettings(min_range_m=1.0, max_range_m=80.0, kitti_correction="off")
FORCED = InputSettings(min_range_m=1.0, max_range_m=80.0, kitti_correction="on")
# a lidar that looks along the camera's z, with a shift and a small tilt: far from the identity
TILT = Rotation.from_rotvec([0.02, -0.01, 0.03]).as_matrix()
R_CAM_LIDAR = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]) @ TILT
T_CAM_LIDAR = np.vstack([np.column_stack([R_CAM_LIDAR, [0.1, -0.2, -0.3]]), [0, 0, 0, 1]])


def text_of(matrix):
    return " ".join(repr(float(x)) for x in matrix[:3].ravel())


def camera_poses(count):
    poses = np.tile(np.eye(4), (count, 1, 1))
    for i in range(1, count):
        poses[i, :3, :3] = Rotation.from_rotvec([0.01 * i, -0.1 * i, 0.02]).as_matrix()
        poses[i, :3, 3] = [0.2 * i, -0.05 * i, 1.4 * i]
    return poses


def points_of(index, count=300):
    rng = np.random.default_rng(index)
    return rng.uniform(2, 20, (count, 3)).astype("<f4")


def write_scan(path, points):
    full = np.column_stack([points, np.full(len(points), 0.5)]).astype("<f4")
    path.write_bytes(full.tobytes())


@pytest.fixture
def root(tmp_path):
    """Sequences 01 (3 scans, poses) and 02 (1 scan, no poses)."""
    for name, count in (("01", 3), ("02", 1)):
        folder = tmp_path / "sequences" / name
        (folder / "velodyne").mkdir(parents=True)
        for index in range(count):
            write_scan(folder / "velodyne" / f"{index:06d}.bin", points_of(index))
        calib = f"P0: {text_of(np.eye(4))}\nTr: {text_of(T_CAM_LIDAR)}\n"
        (folder / "calib.txt").write_text(calib)
        (folder / "times.txt").write_text("".join(f"{0.1 * i:e}\n" for i in range(count)))
    (tmp_path / "poses").mkdir()
    rows = "".join(text_of(pose) + "\n" for pose in camera_poses(3))
    (tmp_path / "poses" / "01.txt").write_text(rows)
    return tmp_path


def elevation_deg(points):
    return np.degrees(np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1])))


def test_correction_raises_the_elevation_and_nothing_else():
    points = np.random.default_rng(0).uniform(-50, 50, (1000, 3))
    turned = raise_elevation(points, 0.205)
    np.testing.assert_allclose(elevation_deg(turned) - elevation_deg(points), 0.205, atol=1e-10)
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    np.testing.assert_allclose(np.arctan2(turned[:, 1], turned[:, 0]), azimuth, atol=1e-12)
    ranges = np.linalg.norm(points, axis=1)
    np.testing.assert_allclose(np.linalg.norm(turned, axis=1), ranges, rtol=1e-14)
    on_axis = np.array([[0.0, 0.0, 5.0], [0.0, 0.0, 0.0]])
    assert np.array_equal(raise_elevation(on_axis, 0.205), on_axis)


def test_correction_by_hand():
    turned = raise_elevation(np.array([[0.0, -10.0, 0.0]]), 90.0)
    np.testing.assert_allclose(turned, [[0.0, 0.0, 10.0]], atol=1e-14)


def test_golden_bytes(tmp_path):
    ten = np.array([1.0, 2.0, 2.0, 0.5], "<f4").tobytes()
    assert ten.hex() == "0000803f00000040000000400000003f"
    (tmp_path / "a.bin").write_bytes(bytes.fromhex("0000803f00000040000000400000003f") * 100)
    points = read_scan(tmp_path / "a.bin", OFF)
    assert np.array_equal(points, np.tile([1.0, 2.0, 2.0], (100, 1)))


def test_sequence_streams_in_order_with_times_and_correction(root):
    dataset = open_dataset(root, FORCED, sequence="1")
    assert (dataset.name, len(dataset), dataset.simulated, dataset.warnings) == ("01", 3, False, ())
    for index, scan in enumerate(dataset):
        assert scan.index == index
        assert scan.stamp_s == pytest.approx(0.1 * index, abs=1e-6)
        expected = raise_elevation(points_of(index).astype(float), 0.205)
        np.testing.assert_allclose(scan.points_lidar, expected, atol=1e-12)
        assert scan.point_times_s is None


def test_start_and_stop(root):
    dataset = open_dataset(root, SETTINGS, sequence="01")
    assert [scan.index for scan in dataset.iterate(1)] == [1, 2]
    assert [scan.index for scan in dataset.iterate(1, 2)] == [1]
    assert [scan.index for scan in dataset.iterate(2, 99)] == [2]
    assert np.array_equal(
        next(dataset.iterate(2)).points_lidar, list(dataset.iterate())[2].points_lidar
    )


def test_correction_is_off_for_simulated_sequences_and_switchable(root):
    def first(settings, sequence="01"):
        return next(open_dataset(root, settings, sequence=sequence).iterate()).points_lidar

    raw = points_of(0).astype(float)
    assert np.array_equal(first(OFF), raw)
    (root / "sequences" / "01" / "simulation.json").write_text("{}")
    assert np.array_equal(first(SETTINGS), raw)
    assert open_dataset(root, SETTINGS, sequence="01").simulated
    assert np.array_equal(first(FORCED), raise_elevation(raw, 0.205))


@pytest.mark.parametrize(
    ("lowest_deg", "highest_deg", "turned_deg"), [(-24.9, 2.0, 0.205), (-30.7, 10.7, 0.0)]
)
def test_only_the_field_of_view_of_an_hdl64_is_corrected(
    root, rng, lowest_deg, highest_deg, turned_deg
):
    """Velodyne's data sheets: HDL-64E from -24.9 to 2 degrees, HDL-32E from -30.7 to 10.7."""
    azimuth = rng.uniform(-np.pi, np.pi, 3000)
    elevation = np.radians(rng.uniform(lowest_deg, highest_deg, 3000))
    flat = np.cos(elevation)
    rays = np.column_stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)])
    points = (rng.uniform(3, 60, (3000, 1)) * rays).astype("<f4")
    for index in range(3):
        write_scan(root / "sequences" / "01" / "velodyne" / f"{index:06d}.bin", points)
    expected = raise_elevation(points.astype(float), turned_deg)
    for scan in open_dataset(root, SETTINGS, sequence="01"):
        np.testing.assert_allclose(scan.points_lidar, expected, atol=1e-9)


def test_single_scan_of_a_sequence_is_corrected_as_in_the_sequence(root):
    path = root / "sequences" / "01" / "velodyne" / "000001.bin"
    scans = list(open_dataset(root, SETTINGS, sequence="01"))
    assert np.array_equal(read_scan(path, SETTINGS), scans[1].points_lidar)


def test_a_single_scan_is_read_from_its_file_once(root, monkeypatch):
    read, read_bytes = [], Path.read_bytes
    monkeypatch.setattr(Path, "read_bytes", lambda path: read.append(path) or read_bytes(path))
    path = root / "sequences" / "01" / "velodyne" / "000001.bin"
    read_scan(path, SETTINGS)
    assert read == [path]


def test_truth_is_in_the_lidar_frame(root):
    dataset = open_dataset(root, SETTINGS, sequence="01")
    np.testing.assert_allclose(dataset.T_cam_lidar, T_CAM_LIDAR, atol=1e-12)
    point = np.array([4.0, -1.0, 0.5, 1.0])
    for i, pose in enumerate(camera_poses(3)):
        in_camera_world = pose @ (T_CAM_LIDAR @ point)
        expected = np.linalg.solve(T_CAM_LIDAR, in_camera_world)
        np.testing.assert_allclose(dataset.truth[i] @ point, expected, atol=1e-9)
    # driving on, the camera's z is the lidar's x: truth must go forward along x
    assert dataset.truth[2, 0, 3] > 2.5


@pytest.mark.parametrize("part", ["sequences", "sequences/01", "sequences/01/velodyne"])
def test_any_folder_of_the_layout_may_be_given(root, part):
    sequence = "01" if part == "sequences" else None
    dataset = open_dataset(root / part, SETTINGS, sequence=sequence)
    assert (dataset.name, len(dataset)) == ("01", 3)
    assert dataset.truth is not None


def test_poses_inside_the_sequence_serve_too(root):
    (root / "poses" / "01.txt").rename(root / "sequences" / "01" / "poses.txt")
    assert len(open_dataset(root, SETTINGS, sequence="01").truth) == 3


def test_part_of_a_sequence_takes_the_rows_of_its_scan_numbers(root):
    whole = open_dataset(root, SETTINGS, sequence="01").truth
    (root / "sequences" / "01" / "velodyne" / "000000.bin").unlink()
    part = open_dataset(root, SETTINGS, sequence="01")
    assert np.array_equal(part.truth, whole[1:])
    assert next(part.iterate()).stamp_s == pytest.approx(0.1, abs=1e-6)


def test_missing_times_are_assumed_and_said(root):
    (root / "sequences" / "01" / "times.txt").unlink()
    dataset = open_dataset(root, SETTINGS, sequence="01")
    assert [scan.stamp_s for scan in dataset] == [0.0, 0.1, 0.2]
    assert "times.txt: not found" in dataset.warnings[0]


def test_range_limits_and_nan_points(root):
    points = points_of(0)
    points[0] = [np.nan, 1, 1]
    points[1] = [np.inf, 1, 1]
    points[2] = [0.5, 0.5, 0.5]
    points[3] = [81, 0, 0]
    points[4] = [3e38, 3e38, 3e38]
    path = root / "sequences" / "01" / "velodyne" / "000000.bin"
    write_scan(path, points)
    assert np.array_equal(read_scan(path, OFF), points[5:].astype(float))


def test_scans_are_not_kept(root):
    dataset = open_dataset(root, SETTINGS, sequence="01")
    alive = []
    for scan in dataset:
        alive.append(weakref.ref(scan.points_lidar))
        del scan
        gc.collect()
        assert sum(ref() is not None for ref in alive) == 0


def spoil(path, content):
    def apply(root):
        target = root / "sequences" / "01" / path
        if content is None:
            target.unlink()
        else:
            target.write_bytes(content)

    return apply


NAN_SCAN = np.full((200, 4), np.nan, "<f4").tobytes()
FIRST = "velodyne/000000.bin"


@pytest.mark.parametrize(
    ("damage", "complaint"),
    [
        (spoil(FIRST, b""), r"000000\.bin: is empty"),
        (spoil(FIRST, bytes(1001)), r"000000\.bin: 1001 bytes is not a whole number of 16-byte"),
        (spoil(FIRST, NAN_SCAN), r"000000\.bin: 0 of 200 points"),
        (spoil(FIRST, b"\x00\x00\x80\x40" * 4 * 50), r"000000\.bin: 50 of 50 .* at least 100"),
        (spoil("calib.txt", None), r"calib\.txt: not found"),
        (spoil("calib.txt", b"P0: 1 2 3\n"), r"calib\.txt: no rigid transform"),
        (spoil("calib.txt", b"Tr: 1 0 0 0\n"), r"calib\.txt: no rigid transform"),
        (spoil("calib.txt", b"Tr: " + b"3 " * 12), r"calib\.txt: no rigid transform"),
        (spoil("calib.txt", b"Tr: " + b"x " * 12), r"calib\.txt: no rigid transform"),
        (spoil("times.txt", b"0\n0.2\n0.1\n"), r"times\.txt: times do not increase"),
        (spoil("times.txt", b"0\n0.1\n"), r"times\.txt: has 2 rows for 3 scans"),
        (spoil("times.txt", b"0\n0.1\nnan\n"), r"times\.txt: line 3"),
        (spoil("../../poses/01.txt", b"1 2 3\n"), r"01\.txt: line 1 is not 12"),
    ],
)
def test_damaged_files_are_named(root, damage, complaint):
    damage(root)
    with pytest.raises(InputError, match=complaint):
        next(open_dataset(root, SETTINGS, sequence="01").iterate())


def test_wrong_sequence_lists_what_there_is(root):
    with pytest.raises(InputError, match=r"no sequence '07'; it has 01, 02"):
        open_dataset(root, SETTINGS, sequence="07")
    with pytest.raises(InputError, match=r"has sequences 01, 02; choose"):
        open_dataset(root, SETTINGS)
    with pytest.raises(InputError, match="is one sequence"):
        open_dataset(root / "sequences" / "01", SETTINGS, sequence="02")


def test_missing_and_empty_places(tmp_path):
    with pytest.raises(InputError, match="nowhere: not found"):
        open_dataset(tmp_path / "nowhere", SETTINGS)
    with pytest.raises(InputError, match="cannot be read"):
        open_dataset(tmp_path / ("x" * 300), SETTINGS)  # a name no file system takes
    with pytest.raises(InputError, match="holds no scans"):
        open_dataset(tmp_path, SETTINGS)
    with pytest.raises(InputError, match="no KITTI sequence"):
        open_dataset(tmp_path, SETTINGS, dataset="kitti")
    (tmp_path / "velodyne").mkdir()
    with pytest.raises(InputError, match=r"velodyne: holds no scans; expected \*\.bin"):
        open_dataset(tmp_path, SETTINGS)
    with pytest.raises(InputError, match="nuscenes: unknown kind"):
        open_dataset(tmp_path, SETTINGS, dataset="nuscenes")


REAL = Path(__file__).parents[2] / ".." / "shared" / "benchmarks"


@pytest.mark.skipif(not REAL.is_dir(), reason="the public ground truths are not here")
def test_every_public_ground_truth_reads():
    from sl3d_slam.io.trajectory import read_kitti_poses

    files = sorted(REAL.glob("*kitti*poses*/*.txt"))
    assert files
    for path in files:
        assert len(read_kitti_poses(path)) > 100

"""What joint training learns from: labels of towns, of files, of lines that a drive confirms."""

import numpy as np
import pytest

from sl3d_slam.errors import InputError
from sl3d_slam.geometry.se3 import from_yaw, invert
from sl3d_slam.geometry.segments import transform_segments
from sl3d_slam.learning.landmarks import distances_to_segments, find_landmarks, label_points
from sl3d_slam.learning.prepare import DriveSource, find_sources, prepare_drive
from sl3d_slam.learning.prepared import BACKGROUND, IGNORED
from sl3d_slam.learning.scan_labels import network_labels
from sl3d_slam.lines.network.settings import NetworkSettings
from sl3d_slam.simulation.drive import plan_drive
from sl3d_slam.simulation.roads import Road
from sl3d_slam.simulation.town import build_town
from sl3d_slam.simulation.write import Layout, write_drive
from sl3d_slam.types import LineKind, LineSet

NETWORK = NetworkSettings()


@pytest.fixture(scope="module")
def town(tmp_path_factory):
    """Three scans, 12 m apart, on a bent road through a town, with true labels."""
    s = np.arange(0.0, 40.0, 12.0)[:3]
    path = np.column_stack([s, 0.02 * s**2, np.zeros(3), np.arctan(0.04 * s)])
    drive = plan_drive(build_town(Road("bend", path), seed=52), "hdl32")
    folder = write_drive(drive, Layout(tmp_path_factory.mktemp("town")))
    return drive, folder


def test_labels_of_a_town_lie_on_its_true_lines(town, tmp_path):
    drive, folder = town
    prepared = prepare_drive(find_sources([folder], [])[0], tmp_path, NETWORK)
    assert prepared.simulated
    np.testing.assert_allclose(prepared.T_world_lidar, drive.T_town_lidar, atol=1e-6)
    true = drive.town.lines
    for scan, T_town_lidar in zip(prepared.scans, drive.T_town_lidar, strict=True):
        assert len(scan.endpoints) > 5
        assert set(scan.kinds.tolist()) <= {LineKind.POLE, LineKind.VERTICAL_EDGE}
        for row, ends in enumerate(scan.endpoints):
            members = scan.points[scan.line_ids == row, :3]
            assert len(members) >= 3
            distance = distances_to_segments(members, ends[None].astype(float))[0]
            # 0.13 m the edge's width, 0.35 m a trunk's radius, 0.22 m half a voxel's diagonal
            assert distance.max() < 0.35 + 0.22 + 0.1
            # a labelled line is a part of a true one
            standing = np.isin(true.kinds, (LineKind.POLE, LineKind.VERTICAL_EDGE))
            segments = transform_segments(invert(T_town_lidar), true.endpoints[standing])
            assert distances_to_segments(ends, segments)[0].max() < 1e-3


def test_other_edges_of_a_town_are_not_known(town, tmp_path):
    drive, folder = town
    prepared = prepare_drive(find_sources([folder], [])[0], tmp_path, NETWORK)
    other = drive.town.lines.endpoints[drive.town.lines.kinds == LineKind.OTHER_EDGE]
    unknown = 0
    for scan, T_town_lidar in zip(prepared.scans, drive.T_town_lidar, strict=True):
        points = scan.points[scan.line_ids == IGNORED, :3]
        gap = distances_to_segments(points, transform_segments(invert(T_town_lidar), other))[0]
        unknown += int((gap < 0.4).sum())
    assert unknown > 0


def test_a_drive_is_prepared_once(town, tmp_path):
    _, folder = town
    source = find_sources([folder], [])[0]
    counted = []
    first = prepare_drive(source, tmp_path, NETWORK, counted.append)
    again = prepare_drive(source, tmp_path, NETWORK, counted.append)
    assert len(counted) == 3
    np.testing.assert_array_equal(first.scans[2].line_ids, again.scans[2].line_ids)
    finer = prepare_drive(source, tmp_path, NetworkSettings(voxel_size_m=0.2), counted.append)
    assert len(counted) == 6
    assert len(finer.scans[0].points) > len(first.scans[0].points)


def test_labels_from_files(town, tmp_path, rng):
    """A scan of a wall and a pole, whose labels another program wrote."""
    wall = np.c_[rng.uniform(-8, 8, 4000), np.full(4000, 6.0), rng.uniform(-1.5, 2.5, 4000)]
    pole = np.c_[np.full(300, 4.0), np.full(300, -3.0), rng.uniform(-1.4, 2.0, 300)]
    ground = np.c_[rng.uniform(-20, 20, (6000, 2)), np.full(6000, -1.7)]
    points = np.concatenate([wall, pole, ground])
    folder = tmp_path / "drive"
    (folder / "labels").mkdir(parents=True)
    for index in range(2):
        rows = np.c_[points, np.zeros(len(points))].astype("<f4")
        rows.tofile(folder / f"{index:06d}.bin")
        ids = np.full(len(points), BACKGROUND, np.int32)
        ids[:100] = IGNORED
        ids[4000:4300] = 0
        ends = np.array([[[4.0, -3.0, -1.4], [4.0, -3.0, 2.0]]], np.float32)
        np.savez(folder / "labels" / f"{index:06d}.npz", line_id=ids, endpoints=ends)
    source = find_sources([folder], [])[0]
    assert source == DriveSource(folder, folder / "labels")
    scan = prepare_drive(source, tmp_path / "cache", NETWORK).scans[1]
    members = scan.points[scan.line_ids == 0, :2]
    np.testing.assert_allclose(members, np.tile([4.0, -3.0], (len(members), 1)), atol=1e-3)
    assert 10 <= len(members) <= 16  # 3.4 m in voxels of 0.25 m, less what lies at the ground
    assert (scan.line_ids == BACKGROUND).sum() > 100
    (folder / "labels" / "000000.npz").unlink()
    assert len(prepare_drive(source, tmp_path / "one", NETWORK).scans) == 1  # the labelled one
    np.savez(folder / "labels" / "000001.npz", line_id=ids[:-5], endpoints=ends)
    with pytest.raises(InputError, match=r"000001\.npz: 10295 labels for a scan of 10300 points"):
        prepare_drive(source, tmp_path / "anew", NETWORK)
    (folder / "labels" / "000001.npz").write_bytes(b"no archive")
    with pytest.raises(InputError, match=r"000001\.npz: expected labels"):
        prepare_drive(source, tmp_path / "anew", NETWORK)


def test_labels_are_found_beside_scans_and_below_label_folders(town, tmp_path):
    _, folder = town
    drive = tmp_path / "01"
    for place in ("velodyne", "../made/01/round1/labels", "../made/01/round2/labels"):
        (drive / place).mkdir(parents=True)
    assert find_sources([folder.parent.parent], [])[0].labels == folder / "labels"
    assert find_sources([drive], [tmp_path / "made"])[0].labels is None
    for number in (1, 2):
        labels = tmp_path / "made" / "01" / f"round{number}" / "labels"
        np.savez(labels / "000000.npz", line_id=np.zeros(1, np.int32))
    for given in ("made", "made/01", "made/01/round2", "made/01/round2/labels"):
        assert find_sources([drive], [tmp_path / given])[0].labels == labels
    assert find_sources([folder], [tmp_path / "made"])[0].labels == folder / "labels"


def test_network_labels_prefer_the_line(rng):
    raw = np.array([[5.0, 0.0, 1.0], [5.08, 0.0, 1.0], [9.0, 0.0, 1.0]])
    line_ids = np.array([-1, 3, -2], np.int32)
    points = np.array([[5.01, 0.0, 1.0], [5.3, 0.0, 1.0], [8.9, 0.0, 1.0], [4.9, 0, 1.0]])
    assert network_labels(points, raw, line_ids).tolist() == [3, 3, -2, -1]


POSES = np.stack([from_yaw(0.05 * k, np.array([1.5 * k, 0.02 * k * k, 0.1])) for k in range(10)])
POLE = np.array([[8.0, 5.0, -1.5], [8.0, 5.0, 3.0]])
CORNER = np.array([[3.0, -7.0, -1.5], [3.0, -7.0, 5.0]])


def lines_seen(rng, skip=(), extra=None):
    """What an extractor finds in each of ten scans, with 3 cm of noise."""
    found = []
    for k, T in enumerate(POSES):
        world = [
            line for name, line in (("pole", POLE), ("corner", CORNER)) if (name, k) not in skip
        ]
        kinds = [
            kind
            for name, kind in (("pole", LineKind.POLE), ("corner", LineKind.VERTICAL_EDGE))
            if (name, k) not in skip
        ]
        if extra is not None and extra(k) is not None:
            world.append(extra(k))
            kinds.append(LineKind.POLE)
        ends = transform_segments(invert(T), np.array(world)) + rng.normal(
            0, 0.03, (len(world), 1, 3)
        )
        count = len(world)
        found.append(
            LineSet(
                ends, np.zeros((count, 0), np.float32), np.full(count, 9), np.array(kinds, np.uint8)
            )
        )
    return found


def test_landmarks_are_what_comes_back_from_other_places(rng):
    flicker = np.array([[0.0, 9.0, 0.0], [0.0, 9.0, 2.0]])
    car = lambda k: np.array([[2.0 * k, 3.0, 0.0], [2.0 * k, 3.0, 1.5]])  # noqa: E731
    found = find_landmarks(lines_seen(rng, extra=car), POSES)
    assert found.confirmed.tolist() == [True, True]
    assert set(found.kinds.tolist()) == {LineKind.POLE, LineKind.VERTICAL_EDGE}
    pole = found.endpoints[found.kinds == LineKind.POLE][0]
    np.testing.assert_allclose(pole[:, :2], POLE[:, :2], atol=0.05)  # 3 cm / sqrt(10), twice over
    short = find_landmarks(
        lines_seen(rng, extra=lambda k: flicker if k in (4, 5, 6) else None), POSES
    )
    assert sorted(short.confirmed.tolist()) == [False, True, True]


def test_a_landmark_labels_scans_in_which_it_was_missed(rng):
    landmarks = find_landmarks(lines_seen(rng, skip={("pole", 6)}), POSES)
    T = POSES[6]
    on_pole = np.c_[np.tile(POLE[0, :2], (30, 1)), np.linspace(-1.3, 2.8, 30)]
    beside = on_pole + np.array([0.3, 0.0, 0.0])
    away = on_pole + np.array([3.0, 0.0, 0.0])
    local = np.concatenate([on_pole, beside, away])
    local = (local - T[:3, 3]) @ T[:3, :3]
    labels, endpoints, kinds = label_points(local, landmarks, T, POSES[:, :3, 3])
    assert kinds.tolist() == [LineKind.POLE]  # no point on the corner
    assert set(labels[:30].tolist()) == {0}
    assert set(labels[30:60].tolist()) == {IGNORED}
    assert set(labels[60:].tolist()) == {BACKGROUND}
    distance = distances_to_segments(local[:30], endpoints)[0]
    assert distance.max() < 0.15


def test_no_lines_at_all():
    nothing = LineSet(np.zeros((0, 2, 3)), np.zeros((0, 0), np.float32), np.zeros(0, np.int64))
    landmarks = find_landmarks([nothing] * 3, POSES[:3])
    labels, endpoints, _ = label_points(np.ones((4, 3)), landmarks, POSES[0], POSES[:3, :3, 3])
    assert labels.tolist() == [BACKGROUND] * 4
    assert len(endpoints) == 0

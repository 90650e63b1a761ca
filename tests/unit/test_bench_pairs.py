"""Pairs for bench registration: by distance, turned, and from public lists."""

import numpy as np
import pytest

from sl3d_slam.bench.pairs import (
    ScanPair,
    choose_pairs,
    pairs_at_distance,
    random_turn,
    read_pair_list,
)
from sl3d_slam.errors import InputError
from sl3d_slam.geometry.se3 import from_yaw, invert, rotation_angle_rad, transform_points

HEADING = "seq i seq_db j " + " ".join(f"mot{k}" for k in range(1, 17))
ROW = "8 3 8 14 0 -1 0 4.5 1 0 0 -2.25 0 0 1 0.5 0 0 0 1"


def street(count, step_m=1.0):
    return np.stack([from_yaw(0.01 * k, np.array([step_m * k, 0.0, 0.0])) for k in range(count)])


def there_and_back(count):
    return np.concatenate([street(count), street(count)[::-1]])


def test_all_pairs_at_a_distance_and_no_others():
    poses = street(60)
    pairs = pairs_at_distance(poses, 20.0, along_track=False)
    expected = {(a, b) for a in range(60) for b in range(60) if 19 <= b - a <= 21}
    assert {tuple(pair) for pair in pairs} == expected


def test_drifting_truth_pairs_no_scans_with_much_travel_between():
    poses = there_and_back(60)
    free = pairs_at_distance(poses, 20.0, along_track=False)
    near = pairs_at_distance(poses, 20.0, along_track=True)
    assert (free[:, 1] - free[:, 0]).max() > 90
    assert (near[:, 1] - near[:, 0]).max() <= 41  # 1.5 times 20 m and 10 m, 1 m a scan


def test_pairs_come_evenly_from_drives_and_a_short_one_is_topped_up(rng):
    drives = [street(200), street(24), street(200)]
    chosen = choose_pairs(drives, 20.0, 60, rng, along_track=False)
    counts = [sum(drive == k for drive, _, _ in chosen) for k in range(3)]
    assert len(chosen) == len(set(chosen)) == 60
    assert counts[1] == len(pairs_at_distance(drives[1], 20.0, False))
    assert abs(counts[0] - counts[2]) <= 1
    forward = sum(a < b for _, a, b in chosen)
    assert 15 <= forward <= 45  # a fair coin: 30 of 60, five standard deviations either way


def test_the_seed_alone_decides():
    first, again, other = (
        choose_pairs([street(99)], 30.0, 20, np.random.default_rng(seed), False)
        for seed in (5, 5, 6)
    )
    assert first == again != other


def test_too_few_pairs_are_all_taken(rng):
    assert len(choose_pairs([street(22)], 20.0, 50, rng, False)) == 6  # 3 + 2 + 1 of 19, 20, 21 m
    assert choose_pairs([street(5)], 20.0, 50, rng, False) == []


def test_truth_of_turned_scans_takes_turned_points_to_turned_points(rng):
    points_world = rng.uniform(-9, 9, (20, 3))
    T_world_source, T_world_target = (
        from_yaw(1.0, np.array([1.0, 2, 3])),
        from_yaw(-2.0, np.ones(3)),
    )
    pair = ScanPair(
        0,
        1,
        0,
        2,
        invert(T_world_target) @ T_world_source,
        random_turn(rng, True, 10.0),
        random_turn(rng, False, 10.0),
    )
    source = transform_points(pair.T_turned_source @ invert(T_world_source), points_world)
    target = transform_points(pair.T_turned_target @ invert(T_world_target), points_world)
    np.testing.assert_allclose(transform_points(pair.truth, source), target, atol=1e-12)


def test_turns_keep_within_their_tilt(rng):
    ups = np.array([random_turn(rng, True, 10.0)[:3, :3] @ [0, 0, 1] for _ in range(500)])
    tilts = np.degrees(np.arccos(np.clip(ups[:, 2], -1, 1)))
    assert 10.0 < tilts.max() <= 14.2  # both axes at 10 deg make sqrt(2) times 10
    level = np.array([random_turn(rng, True, 0.0) for _ in range(200)])
    np.testing.assert_allclose(level[:, 2, 2], 1.0, atol=1e-15)
    yaws = [rotation_angle_rad(turn) for turn in level]
    assert max(yaws) > 3.0
    np.testing.assert_array_equal(random_turn(rng, False, 0.0), np.eye(4))


def test_a_list_of_pairs_is_read(tmp_path):
    path = tmp_path / "test.txt"
    path.write_text(f"{HEADING}\n{ROW}\n\n")
    ((sequence, source, sequence_db, target, T_target_source),) = read_pair_list(path)
    assert (sequence, source, sequence_db, target) == (8, 3, 8, 14)
    moved = transform_points(T_target_source, np.array([[1.0, 0.0, 0.0]]))
    np.testing.assert_allclose(moved, [[4.5, -1.25, 0.5]], atol=1e-12)


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        ("", "line 1"),
        (ROW, "line 1"),
        (HEADING, "no pairs"),
        (f"{HEADING}\n{ROW} 7", "line 2.*found 21"),
        (f"{HEADING}\n{ROW}\n8 3 8", "line 3.*found 3"),
        (f"{HEADING}\n{ROW.replace('4.5', 'far')}", "line 2"),
        (f"{HEADING}\n{ROW.replace('8 3 8', '8 3.5 8')}", "line 2"),
        (f"{HEADING}\n{ROW.replace('8 3 8', '8 -3 8')}", "line 2.*negative"),
        (f"{HEADING}\n{ROW.replace('4.5', 'nan')}", "line 2"),
        (f"{HEADING}\n{ROW.replace('0 -1 0 4.5', '0 -2 0 4.5')}", "line 2.*rigid"),
        (f"{HEADING}\n{ROW.replace('0 0 0 1', '0 0 1 1')}", "line 2.*0 0 0 1"),
        (b"\xff\xfe\x00", "text"),
    ],
)
def test_a_malformed_list_is_refused_with_its_name_and_line(tmp_path, content, complaint):
    path = tmp_path / "pairs.txt"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(InputError, match=rf"pairs\.txt.*{complaint}"):
        read_pair_list(path)


def test_a_missing_list_is_named(tmp_path):
    with pytest.raises(InputError, match=r"none\.txt"):
        read_pair_list(tmp_path / "none.txt")


@pytest.mark.parametrize(
    ("name", "used"), [("kitti_10m/test.txt", 8), ("kitti_lc/test_10_20.txt", 0)]
)
def test_public_lists_take_source_to_target_in_the_lidar_frame(shared, name, used):
    """Compared with SemanticKITTI's poses on a sequence whose loops are in the same direction."""
    poses = shared / "benchmarks" / "sem_kitti_poses"
    T_camera_lidar = np.array([[0, -1, 0, 0], [0, 0, -1, -0.08], [1, 0, 0, -0.27], [0, 0, 0, 1.0]])
    off_m, swapped_m = [], []
    for sequence, source, _, target, T_target_source in read_pair_list(
        shared / "benchmarks" / name
    ):
        if sequence != used:
            continue
        if not off_m:
            rows = np.loadtxt(poses / f"{sequence:02d}.txt").reshape(-1, 3, 4)
        T_world_source, T_world_target = (
            np.vstack([rows[k], [0, 0, 0, 1]]) @ T_camera_lidar for k in (source, target)
        )
        true = np.linalg.inv(T_world_target) @ T_world_source
        off_m.append(np.linalg.norm(true[:3, 3] - T_target_source[:3, 3]))
        swapped_m.append(np.linalg.norm(np.linalg.inv(true)[:3, 3] - T_target_source[:3, 3]))
    assert len(off_m) > 20
    # The calibration is only roughly KITTI's here: a degree at 20 m is 0.3 m.
    assert np.median(off_m) < 0.6
    assert np.median(swapped_m) > 5.0

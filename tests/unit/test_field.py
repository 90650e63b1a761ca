"""The bird's-eye field: an asymmetric street speaks for its true pose and against shifted ones."""

import numpy as np
import pytest
from scipy import ndimage

from sl3d_slam.geometry.se3 import from_yaw, invert, transform_points
from sl3d_slam.matching.field import SIZE, build_field, invert_poses, score_poses

POSE = np.array([np.radians(137.0), 6.0, -4.0])  # of the source in the target
T_TARGET_SOURCE = from_yaw(POSE[0], np.array([POSE[1], POSE[2], 0.0]))


def street(rng):
    """Ground with walls left and right (gaps at uneven places), and three kiosks; z = height."""
    ground = np.c_[rng.uniform(-40, 40, (30_000, 2)), np.zeros(30_000)]
    x = np.arange(-40, 40, 0.2)
    parts = [ground[np.abs(ground[:, 1]) < 9.0]]
    for side, gaps in ((8.0, [(-30, -22), (3, 7)]), (-7.0, [(-12, -9), (18, 31)])):
        wall = x[~np.any([(x > a) & (x < b) for a, b in gaps], axis=0)]
        parts += [np.c_[wall, np.full_like(wall, side), np.full_like(wall, z)] for z in (1, 2, 3.0)]
    for place in ((-17.0, 4.0), (9.0, -4.0), (26.0, 3.0)):
        box = np.array(place) + rng.uniform(-0.8, 0.8, (150, 2))
        parts.append(np.c_[box, rng.uniform(0.6, 2.5, 150)])
    return np.concatenate(parts)


@pytest.fixture(scope="module")
def fields():
    """Source and target fields of one street; heights are those above ground."""
    target = street(np.random.default_rng(1))
    source = transform_points(invert(T_TARGET_SOURCE), street(np.random.default_rng(2)))
    return tuple(build_field(cloud, cloud[:, 2].astype(np.float32)) for cloud in (source, target))


def test_the_true_pose_scores_best(fields):
    source, target = fields
    shifts = np.array([[2.0, 0], [-2, 0], [0, 2], [0, -2], [10, 0], [-10, 0], [25, 0]])
    others = [POSE + np.r_[0, shift] for shift in shifts]
    others += [POSE + np.r_[turn, 0, 0] for turn in (0.15, -0.15, np.pi)]
    scores = score_poses(source, target, np.array([POSE, *others]))
    assert scores[0] > 0.8
    assert scores[1:].max() < scores[0] - 0.1


def test_the_pose_maps_source_into_target_and_not_back(fields):
    source, target = fields
    back = invert_poses(POSE[None])
    assert score_poses(target, source, back)[0] > 0.8
    assert score_poses(source, target, back)[0] < 0.6


def test_inverse_poses_are_inverse(rng):
    poses = np.c_[rng.uniform(-np.pi, np.pi, 20), rng.uniform(-50, 50, (20, 2))]
    for pose, inverse in zip(poses, invert_poses(poses), strict=True):
        T = from_yaw(pose[0], np.r_[pose[1:], 0.0]) @ from_yaw(inverse[0], np.r_[inverse[1:], 0.0])
        np.testing.assert_allclose(T, np.eye(4), atol=1e-12)


def test_structure_on_empty_street_is_held_against_a_pose_and_the_unknown_is_not():
    ground = np.stack(np.meshgrid(np.arange(0, 20, 0.25), np.arange(-10, 10, 0.25)), -1)
    ground = np.c_[ground.reshape(-1, 2), np.zeros(80 * 80)]
    target = build_field(ground, np.zeros(len(ground), np.float32))
    box = np.c_[np.random.default_rng(0).uniform(-1, 1, (200, 2)), np.ones(200)]
    source = build_field(box, np.ones(200, np.float32))
    on_street, outside, off_the_map = score_poses(
        source, target, np.array([[0.0, 10.0, 0.0], [0.0, -30.0, 0.0], [0.0, 500.0, 0.0]])
    )
    assert on_street == pytest.approx(-0.6, abs=1e-6)
    assert outside == off_the_map == 0.0


def test_heights_decide_what_is_structure():
    points = np.array([[1.0, 1, 0], [5.0, 5, 0], [9.0, 9, 0]])
    field = build_field(points, np.array([0.4, 4.0, 8.5], np.float32))  # kerb, wall, tree top
    np.testing.assert_allclose(field.points, [[5.25, 5.25]])


def test_values_are_those_of_a_distance_transform(rng):
    """Known to it and to the field: structure nearer than 1.3 m, and street; to the bit."""
    points = np.column_stack([rng.uniform(-85, 85, (4000, 2)), np.zeros(4000)])
    heights = rng.choice(np.array([0.1, 1.0, 20.0], np.float32), 4000, p=[0.5, 0.1, 0.4])
    field = build_field(points, heights)
    cells = np.floor((points[:, :2] + 80.0) / 0.5).astype(int)
    drawn = np.all((cells >= 0) & (cells < SIZE), axis=1)
    masks = np.zeros((2, SIZE, SIZE), bool)
    for mask, height in zip(masks, (0.1, 1.0), strict=True):
        mask[tuple(cells[drawn & (heights == np.float32(height))].T)] = True
    street, gap_m = (
        ndimage.binary_dilation(masks[0]),
        0.5 * ndimage.distance_transform_edt(~masks[1]),
    )
    expected = np.where(gap_m < 1.3, np.exp(-((gap_m / 0.8) ** 2)), np.where(street, -0.6, 0.0))
    np.testing.assert_array_equal(field.value, expected.astype(np.float32))


def test_nothing_seen_says_nothing():
    empty = build_field(np.zeros((0, 3)), np.zeros(0, np.float32))
    assert empty.value.shape == (SIZE, SIZE)
    assert score_poses(empty, empty, np.zeros((2, 3))).tolist() == [0.0, 0.0]

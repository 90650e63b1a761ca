"""A single scan seen from two places: true shadows, true relative poses, lines that stay."""

import numpy as np
import pytest

from sl3d_slam.geometry.se3 import transform_points
from sl3d_slam.learning.joint_settings import JointSettings
from sl3d_slam.learning.pair_source import PairSource
from sl3d_slam.learning.prepared import BACKGROUND, PreparedDrive, PreparedScan
from sl3d_slam.learning.single_scans import prepare_singles
from sl3d_slam.learning.virtual_view import draw_places, seen_from, two_views
from sl3d_slam.lines.network.settings import NetworkSettings


def wall(x, y_range, rng, step=0.3):
    y, z = np.meshgrid(np.arange(*y_range, step), np.arange(-1.5, 2.0, step))
    return np.c_[np.full(y.size, x), y.ravel(), z.ravel()] + rng.normal(0, 0.01, (y.size, 3))


@pytest.fixture
def scan(rng):
    """A wall 10 m ahead, one 20 m ahead beside it, and a pole before the second."""
    near, far = wall(10.0, (-6.0, 0.0), rng), wall(20.0, (3.0, 20.0), rng)
    pole = np.c_[np.tile([14.0, 6.0], (12, 1)), np.arange(12) * 0.3 - 1.5]
    places = np.vstack([near, far, pole])
    ids = np.full(len(places), BACKGROUND, np.int32)
    ids[-12:] = 0
    ends = np.float32([[[14.0, 6.0, -1.5], [14.0, 6.0, 1.8]]])
    points = np.c_[places, places[:, 2] + 1.7].astype(np.float32)
    return PreparedScan(points, ids, ends, np.zeros(1, np.uint8))


def test_what_a_wall_hides_from_the_other_place_is_gone(scan, rng):
    place = np.array([0.0, -9.0, 0.0])  # the near wall now stands before the beginning of the far
    view = seen_from(scan, place, rng)
    back = view.points[:, :3] + place
    far = np.isclose(back[:, 0], 20.0, atol=0.1)
    # the line from the place past the near wall's end (10, 0) meets the far wall at y = 9
    assert back[far, 1].min() > 9.0 - 1.0  # a bin of 2 deg is 0.8 m wide there
    assert (scan.points[:, 1] < 8.0)[np.isclose(scan.points[:, 0], 20.0, atol=0.1)].sum() > 100
    near = np.isclose(back[:, 0], 10.0, atol=0.1)
    assert near.sum() == np.isclose(scan.points[:, 0], 10.0, atol=0.1).sum()  # hides nothing else


def test_two_views_lie_on_each_other(scan, rng):
    places = np.array([[3.0, 1.0, 0.0], [-4.0, -0.5, 0.0]])
    (first, second), T_first_second = two_views(scan, places, rng)
    np.testing.assert_allclose(
        transform_points(T_first_second, second.endpoints[0].astype(float)),
        first.endpoints[0],
        atol=1e-5,
    )
    np.testing.assert_allclose(first.endpoints[0, 0], [11.0, 5.0, -1.5], atol=1e-5)
    for view in (first, second):
        members = view.points[view.line_ids == 0, :3]
        assert len(members) >= 8
        assert np.abs(members[:, :2] - view.endpoints[0, 0, :2]).max() < 1e-4


def test_places_lie_as_far_apart_as_wanted(rng):
    gaps = [np.diff(draw_places(20.0, rng), axis=0)[0] for _ in range(50)]
    assert all(abs(abs(gap[0]) - 20.0) < 1e-9 and abs(gap[1]) <= 4.0 for gap in gaps)
    assert {np.sign(gap[0]) for gap in gaps} == {-1.0, 1.0}


def test_single_scans_make_pairs_with_matches(scan):
    singles = PreparedDrive("singles", False, np.eye(4)[None], (scan,))
    pair = PreparedDrive("street", False, np.tile(np.eye(4), (2, 1, 1)), (scan, scan))
    source = PairSource([pair], JointSettings(points=4000), NetworkSettings(stride=1), [singles])
    assert source.num_pairs == 2
    apart = 0
    for number in range(30):
        batch = source.draw(number)
        assert batch.matches.tolist() in ([[0, 0]], [])
        apart += batch.sizes[0] != batch.sizes[1]
    assert apart > 5


def test_unrelated_scans_are_labelled_by_geometry(tmp_path, rng):
    ground = np.c_[rng.uniform(-20, 20, (9000, 2)), np.full(9000, -1.7)]
    pole = np.c_[rng.normal([7.0, 2.0], 0.03, (500, 2)), rng.uniform(-1.7, 3.0, 500)]
    for index in range(2):
        cloud = np.c_[np.vstack([ground, pole + index]), np.zeros(9500)]
        cloud.astype("<f4").tofile(tmp_path / f"{index:06d}.bin")
    prepared = []
    drive = prepare_singles(tmp_path, tmp_path / "kept", NetworkSettings(), None, prepared.append)
    assert len(drive.scans) == len(prepared) == 2
    for index, scan in enumerate(drive.scans):
        place = np.array([7.0 + index, 2.0 + index])
        assert len(scan.endpoints) == 1
        assert np.abs(scan.endpoints[0, :, :2] - place).max() < 0.1
        assert np.abs(scan.points[scan.line_ids == 0, :2] - place).max() < 0.25
    assert np.linalg.norm(np.diff(drive.T_world_lidar[:, :3, 3], axis=0)) > 500.0
    again = prepare_singles(tmp_path, tmp_path / "kept", NetworkSettings(), None, prepared.append)
    assert len(prepared) == 2
    np.testing.assert_array_equal(again.scans[1].points, drive.scans[1].points)

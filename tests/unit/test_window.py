"""Consecutive scans joined to one view in the frame of the last."""

import numpy as np
import pytest

from sl3d_slam.config import SlamConfig
from sl3d_slam.errors import InputError
from sl3d_slam.geometry.se3 import from_yaw, invert, transform_points
from sl3d_slam.lines.extract import LineExtractor
from sl3d_slam.relocalization.window import join_scans

CONFIG = SlamConfig()
STEPS = [from_yaw(0.03 * k, np.array([0.9 * k, 0.05 * k, 0.0])) for k in range(4)]
POSTS = np.array([[8.0, 5.0], [12.0, -4.0], [-7.0, 6.0], [18.0, 7.0], [-12.0, -5.0], [25.0, -3.0]])


@pytest.fixture(scope="module")
def world():
    """Ground, two long walls with bays, and posts; dense enough for each scan to show them."""
    rng = np.random.default_rng(0)
    ground = np.column_stack([rng.uniform(-35, 45, (30_000, 1)), rng.uniform(-12, 12, (30_000, 1))])
    ground = np.column_stack([ground, np.full(len(ground), -1.7)])
    x, z = rng.uniform(-35, 45, 16_000), rng.uniform(-1.7, 4.0, 16_000)
    side = rng.choice([-1.0, 1.0], 16_000)
    bay = 10.0 + 2.0 * (np.floor(x / 6.0) % 2)
    wall = np.column_stack([x, side * bay, z])
    turn = rng.uniform(0, 2 * np.pi, (len(POSTS), 500))
    post = np.stack(
        [
            POSTS[:, :1] + 0.08 * np.cos(turn),
            POSTS[:, 1:] + 0.08 * np.sin(turn),
            np.tile(np.linspace(-1.7, 3.0, 500), (len(POSTS), 1)),
        ],
        axis=-1,
    ).reshape(-1, 3)
    return np.concatenate([ground, wall, post])


@pytest.fixture(scope="module")
def scans(world):
    rng = np.random.default_rng(1)
    return [transform_points(invert(T), world + rng.normal(0, 0.01, world.shape)) for T in STEPS]


@pytest.fixture(scope="module")
def joined(scans):
    return join_scans(scans, LineExtractor(), CONFIG)


def test_posts_stand_where_the_last_scan_sees_them(joined):
    truth = transform_points(invert(STEPS[-1]), np.column_stack([POSTS, np.zeros(len(POSTS))]))
    middles = joined.lines.endpoints.mean(axis=1)
    gaps = np.linalg.norm(middles[None, :, :2] - truth[:, None, :2], axis=2)
    assert (gaps.min(axis=1) < 0.2).all()  # the radius of a post, voxels, and odometry's 2 cm


def test_a_line_that_every_scan_shows_counts_once(joined):
    truth = transform_points(invert(STEPS[-1]), np.column_stack([POSTS, np.zeros(len(POSTS))]))
    middles = joined.lines.endpoints.mean(axis=1)
    gaps = np.linalg.norm(middles[None, :, :2] - truth[:, None, :2], axis=2)
    assert ((gaps < 0.4).sum(axis=1) == 1).all()


def test_one_scan_alone_is_itself(scans):
    extractor = LineExtractor()
    view = join_scans(scans[:1], extractor, CONFIG)
    alone = extractor.extract(scans[0])
    np.testing.assert_array_equal(view.lines.endpoints, alone.endpoints)


def test_no_scan_and_what_is_no_scan_are_refused():
    with pytest.raises(InputError, match="at least one"):
        join_scans([], LineExtractor(), CONFIG)
    with pytest.raises(InputError, match="points_lidar"):
        join_scans([np.zeros((9, 3))], LineExtractor(), CONFIG)
    with pytest.raises(InputError, match="points_lidar"):
        join_scans([np.zeros((200, 3)), np.zeros((200, 2))], LineExtractor(), CONFIG)

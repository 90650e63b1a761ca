"""Views with foreign and missing parts: what is left is true still, and rows of lines stay."""

import numpy as np
import pytest

from sl3d_slam.learning.joint_settings import AugmentSettings
from sl3d_slam.learning.mixing import scaled, with_foreign_sector, with_holes
from sl3d_slam.learning.prepared import PreparedScan


def ring(rng, lines, mark):
    """Points all around, told apart by their height above ground; posts evenly spread."""
    angle = rng.uniform(0, 2 * np.pi, 4000)
    flat = np.c_[10 * np.cos(angle), 10 * np.sin(angle), rng.uniform(-1, 3, 4000)]
    post = 2 * np.pi * (np.arange(lines) + 0.5) / lines
    posts = np.c_[8 * np.cos(post), 8 * np.sin(post), np.zeros(lines)]
    points = np.c_[np.vstack([flat, posts]), np.full(4000 + lines, mark)].astype(np.float32)
    ids = np.r_[np.full(4000, -1), np.arange(lines)].astype(np.int32)
    ends = np.stack([posts, posts + np.array([0, 0, 4.0])], axis=1).astype(np.float32)
    return PreparedScan(points, ids, ends, np.full(lines, mark, np.uint8))


@pytest.mark.parametrize("seed", range(4))
def test_one_sector_is_the_others(rng, seed):
    own, other = ring(rng, 12, 0), ring(rng, 9, 1)
    how = AugmentSettings(max_foreign_deg=200.0)
    mixed = with_foreign_sector(own, other, how, np.random.default_rng(seed))
    azimuth = np.sort(np.arctan2(*mixed.points[mixed.points[:, 3] == 1][:, 1::-1].T))
    gaps = np.diff(np.r_[azimuth, azimuth[0] + 2 * np.pi])
    width = 2 * np.pi - gaps.max()  # foreign points fill one sector
    mine = np.arctan2(*mixed.points[mixed.points[:, 3] == 0][:, 1::-1].T)
    begin = azimuth[(gaps.argmax() + 1) % len(azimuth)]
    assert ((mine - begin) % (2 * np.pi) > width - 1e-3).all()
    assert width < np.radians(200.0)
    for line in np.unique(mixed.line_ids[mixed.line_ids >= 0]):
        (place,) = mixed.points[mixed.line_ids == line, :3]
        np.testing.assert_array_equal(mixed.endpoints[line, 0], place)
        assert mixed.kinds[line] == (line >= 12)
    np.testing.assert_array_equal(mixed.endpoints[:12], own.endpoints)


def test_holes_are_round_and_lines_keep_their_rows(rng):
    scan = ring(rng, 12, 0)
    scan.points[:, 3] = np.arange(len(scan.points))  # so that each can be told
    left = with_holes(scan, AugmentSettings(max_holes=1), np.random.default_rng(0))
    gone = np.setdiff1d(np.arange(len(scan.points)), left.points[:, 3].astype(int))
    assert 0 < len(gone) == len(scan.points) - len(left.points)
    hole = scan.points[gone, :2]
    middle = hole[np.linalg.norm(hole[:, None] - hole, axis=2).max(axis=1).argmin()]
    radius = np.linalg.norm(hole - middle, axis=1).max()
    assert 0.5 < radius <= 4.0 + 1.0  # the middle's neighbour may be taken for it
    assert (np.linalg.norm(left.points[:, :2] - middle, axis=1) > radius - 1.0).all()
    np.testing.assert_array_equal(left.endpoints, scan.endpoints)
    whole = with_holes(scan, AugmentSettings(max_holes=0), rng)
    assert len(whole.points) == len(scan.points)


def test_a_larger_street(rng):
    scan = ring(rng, 3, 2)
    larger = scaled(scan, 1.1)
    np.testing.assert_allclose(larger.points, 1.1 * scan.points, rtol=1e-6)
    np.testing.assert_allclose(larger.endpoints, 1.1 * scan.endpoints, rtol=1e-6)
    np.testing.assert_array_equal(larger.line_ids, scan.line_ids)

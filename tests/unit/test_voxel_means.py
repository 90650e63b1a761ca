"""Means and first points of voxels: against plain loops."""

from collections import defaultdict

import numpy as np

from sl3d_slam.geometry.voxel_means import first_in_voxels, voxel_means


def test_means_are_those_of_plain_loops_in_the_order_of_the_voxels(rng):
    points = rng.uniform(-9.0, 9.0, (4_000, 3))
    voxels = defaultdict(list)
    for point in points:
        if np.linalg.norm(point) < 8.0:
            voxels[tuple(np.floor(point / 1.5).astype(int))].append(point)
    expected = [np.mean(voxels[voxel], axis=0) for voxel in sorted(voxels)]
    np.testing.assert_allclose(voxel_means(points, 1.5, 8.0), expected, atol=1e-12)


def test_of_no_point_in_range_there_is_no_mean():
    assert voxel_means(np.zeros((0, 3)), 0.5, 70.0).shape == (0, 3)
    assert voxel_means(np.full((5, 3), 100.0), 0.5, 70.0).shape == (0, 3)
    assert voxel_means(np.full((5, 3), np.nan), 0.5, 70.0).shape == (0, 3)


def test_the_first_point_of_each_voxel_is_that_of_a_plain_loop(rng):
    points = np.repeat(rng.uniform(-9.0, 9.0, (1_000, 3)), 3, axis=0)  # beams stay in a voxel
    points += rng.normal(0.0, 0.3, points.shape)
    firsts = {}
    for point in points:
        firsts.setdefault(tuple(np.floor(point / 1.5).astype(int)), point)
    assert len(firsts) < 2_000
    np.testing.assert_array_equal(first_in_voxels(points, 1.5), list(firsts.values()))


def test_no_point_is_the_first_of_none():
    assert first_in_voxels(np.zeros((0, 3)), 0.5).shape == (0, 3)

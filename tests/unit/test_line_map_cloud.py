import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from sl3d_slam.geometry.se3 import exp, invert, transform_points
from sl3d_slam.mapping.varint import pack, pack_table, unpack, unpack_table
from sl3d_slam.mapping.voxels import VoxelCloud, code_voxels, collect_voxels, join_clouds

POSE = exp(np.array([0.1, -0.2, 0.7, 30.0, -12.0, 4.0]))
coordinates = st.floats(-200, 200, allow_nan=False, width=32)
point_sets = hnp.arrays(np.float32, st.tuples(st.integers(0, 60), st.just(3)), elements=coordinates)


@given(st.lists(st.integers(0, 2**42 - 1)))
def test_integers_round_trip(values):
    packed = pack(np.array(values, np.int64))
    assert unpack(packed).tolist() == values
    assert len(packed) == sum(max(1, -(-value.bit_length() // 7)) for value in values)


@given(
    hnp.arrays(
        np.int64,
        st.tuples(st.integers(0, 20), st.just(3)),
        elements=st.integers(1 - 2**40, 2**40 - 1),
    )
)
def test_tables_round_trip(table):
    assert np.array_equal(unpack_table(pack_table(table), 3), table)


def test_known_bytes():
    assert pack(np.array([0, 127, 128, 300])).tolist() == [0, 127, 0x80, 1, 0xAC, 2]
    assert pack_table(np.array([[5], [3], [3]])).tolist() == [10, 3, 0]


@pytest.mark.parametrize("values", [[-1], [2**42]])
def test_integers_that_do_not_fit_are_refused(values):
    with pytest.raises(ValueError, match="too large"):
        pack(np.array(values))


@pytest.mark.parametrize("packed", [[0x80], [1, 0xFF], [0x80] * 6 + [1], [0x80] * 1000 + [0]])
def test_bytes_that_are_no_integers_are_refused(packed):
    with pytest.raises(ValueError, match=r"cut off|too long"):
        unpack(np.array(packed, np.uint8))


def brute_force(points, voxel_m):
    """Return the mean of the points of each occupied voxel, keyed by voxel."""
    cells = {}
    for point in points.astype(float):
        cells.setdefault(tuple(np.floor(point / voxel_m).astype(int)), []).append(point)
    return {cell: np.mean(members, axis=0) for cell, members in cells.items()}


@settings(deadline=None)
@given(point_sets, st.sampled_from([0.3, 0.8, 5.0]))
def test_each_voxel_comes_back_with_its_mean(points, voxel_m):
    cloud = join_clouds([points], voxel_m)
    expected = brute_force(points, voxel_m)
    found = cloud.all_points().astype(float)
    assert len(found) == len(cloud) == len(expected)
    for point in found:
        mean = expected[tuple(np.floor(point / voxel_m).astype(int))]
        # half a step of a 32nd of the voxel, and float32 at 200 m
        assert np.abs(point - mean).max() <= voxel_m / 64 + 2e-5


@settings(deadline=None)
@given(point_sets, st.tuples(coordinates, coordinates, coordinates), st.floats(0, 150))
def test_crop_is_what_brute_force_crops(points, position, radius_m):
    cloud = join_clouds([points], 0.8)
    every = cloud.all_points()
    distance = np.hypot(*(every[:, :2].astype(float) - position[:2]).T)
    cropped = {tuple(p) for p in cloud.near(np.array(position, float), radius_m)}
    assert cropped <= {tuple(p) for p in every[distance < radius_m + 1e-4]}
    assert cropped >= {tuple(p) for p in every[distance < radius_m - 1e-4]}


def test_clouds_are_placed_by_their_poses_and_movers_dropped(rng):
    wall = rng.uniform([0, 0, 0], [20, 0.5, 3], (400, 3))
    poses = np.array([POSE @ exp(np.array([0, 0, 0.1 * k, 1.0 * k, 0, 0])) for k in range(3)])
    clouds = []
    for k, T in enumerate(poses):
        car = rng.uniform([40 + 10 * k, 40, 0], [44 + 10 * k, 42, 1.5], (200, 3))
        seen = np.concatenate([wall, car])
        clouds.append(transform_points(invert(T), seen).astype(np.float32))
    voxels = collect_voxels(iter(clouds), poses, 0.8)
    found = code_voxels(voxels, 0.8, 2).all_points()
    assert len(found) == len(brute_force(wall, 0.8))
    assert found[:, 0].max() < 21
    assert len(code_voxels(voxels, 0.8, 1)) > len(found)


def test_many_keyframes_add_up_as_one(rng):
    points = rng.uniform(-30, 30, (70, 50, 3)).astype(np.float32)
    together = collect_voxels(points, np.tile(np.eye(4), (70, 1, 1)), 4.0)
    means = brute_force(points.reshape(-1, 3), 4.0)
    assert together.points.sum() == 3500
    assert np.allclose(
        sorted((together.sums / together.points[:, None])[:, 0]),
        sorted(mean[0] for mean in means.values()),
    )


def test_point_beyond_all_maps_is_refused():
    with pytest.raises(ValueError, match="voxels from the map's origin"):
        join_clouds([np.array([[1e7, 0.0, 0.0]])], 0.8)


def test_empty_cloud():
    cloud = join_clouds([], 0.8)
    assert isinstance(cloud, VoxelCloud)
    assert cloud.near(np.zeros(3), 50.0).shape == (0, 3)
    assert cloud.transformed(POSE).all_points().shape == (0, 3)

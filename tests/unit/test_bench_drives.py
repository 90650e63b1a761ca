"""Out and back: the revisit made of a one-way drive, against a world whose points are known."""

import numpy as np
import pytest

from sl3d_slam.bench.outback import TURN_SCANS, out_and_back, out_and_back_order, turn_yaws_rad
from sl3d_slam.errors import InputError
from sl3d_slam.geometry.se3 import from_yaw, invert, transform_points
from sl3d_slam.io.dataset import Dataset
from sl3d_slam.types import Scan


def one_way(count, rng):
    """Scans of one fixed set of world points along a bent road, without noise."""
    world = rng.uniform(-30, 30, (200, 3))
    truth = np.stack(
        [from_yaw(0.3 + 0.02 * k, np.array([1.5 * k, 0.1 * k * k, 0.2 * k])) for k in range(count)]
    )

    def read(start, stop):
        for k in range(start, stop):
            yield Scan(k, 0.1 * k, transform_points(invert(truth[k]), world), np.zeros(len(world)))

    return world, Dataset("road", "a road", count, read, truth=truth, simulated=True)


@pytest.mark.parametrize("count", [3, 4, 107, 108])
def test_every_scan_is_used_once_even_ones_first(count):
    order = out_and_back_order(count)
    assert sorted(order) == list(range(count))
    out = order[: (count + 1) // 2]
    back = order[(count + 1) // 2 :]
    assert list(out) == sorted(out)
    assert all(k % 2 == 0 for k in out)
    assert list(back) == sorted(back, reverse=True)
    assert all(k % 2 == 1 for k in back)


def test_turned_scans_and_turned_truth_show_the_same_world(rng):
    world, source = one_way(120, rng)
    back = out_and_back(source)
    for scan, pose in zip(back, back.truth, strict=True):
        seen = transform_points(pose, scan.points_lidar)
        np.testing.assert_allclose(seen, world, atol=1e-9)  # rounding of float64 at 100 m


def test_the_way_back_looks_the_other_way(rng):
    _, source = one_way(120, rng)
    back = out_and_back(source)
    order = out_and_back_order(120)
    for index in (0, 30, 59):
        np.testing.assert_array_equal(back.truth[index], source.truth[order[index]])
    last = invert(source.truth[order[-1]]) @ back.truth[-1]
    np.testing.assert_allclose(last, np.diag([-1.0, -1.0, 1.0, 1.0]), atol=1e-12)


def test_the_turn_is_gradual_and_to_the_left():
    yaws = turn_yaws_rad(200)
    steps = np.diff(yaws)
    assert yaws[0] == 0.0
    assert yaws[-1] == np.pi
    assert steps.min() >= 0.0
    assert steps.max() <= np.pi / TURN_SCANS + 1e-12


def test_only_the_first_scans_and_single_scans_can_be_read(rng):
    _, source = one_way(50, rng)
    back = out_and_back(source, 21)
    assert len(back) == 21
    assert back.simulated
    alone = list(back.iterate(15, 16))
    together = list(back)
    assert [scan.index for scan in together] == list(range(21))
    np.testing.assert_array_equal(alone[0].points_lidar, together[15].points_lidar)
    assert alone[0].point_times_s is None  # they would run against the way back


def test_truth_stays_unknown_where_it_is(rng):
    _, source = one_way(10, rng)
    unknown = Dataset("x", "x", 10, source.read_scans)
    assert out_and_back(unknown).truth is None


def test_two_scans_cannot_come_back(rng):
    _, source = one_way(2, rng)
    with pytest.raises(InputError, match="at least 3"):
        out_and_back(source)

"""Two sides at once: nobody waits for the other, and the answer is that of one after the other."""

import re
import threading
from pathlib import Path

import numpy as np
import pytest

import sl3d_slam
from sl3d_slam.config import MatchingSettings
from sl3d_slam.geometry.se3 import from_yaw, transform_points
from sl3d_slam.lines.extract import LineExtractor
from sl3d_slam.matching.prepared import PreparedView
from sl3d_slam.matching.views import make_view
from sl3d_slam.registration import register_lines, register_views
from sl3d_slam.side_by_side import side_by_side
from sl3d_slam.simulation.drive import simulate_drive


def test_each_side_gets_its_own_and_both_run_at_once():
    meet = threading.Barrier(2, timeout=5)  # breaks where one side runs after the other

    def double(number):
        meet.wait()
        return 2 * number

    assert side_by_side(double, 3, 5) == (6, 10)


@pytest.mark.parametrize(("source", "target"), [(1.0, 0.0), (0.0, 1.0)])
def test_what_either_side_raises_is_raised(source, target):
    with pytest.raises(ZeroDivisionError):
        side_by_side(lambda number: 1.0 / number, source, target)


def test_a_pair_side_by_side_is_the_pair_one_after_the_other(ring_drive):
    target, seen = (scan.points_lidar for scan in simulate_drive(ring_drive, [4, 8]))
    source = transform_points(from_yaw(2.0, np.zeros(3)), seen)
    extractor, settings = LineExtractor(), MatchingSettings()
    lines = extractor.extract(source), extractor.extract(target)
    for alone, beside in zip(lines, side_by_side(extractor.extract, source, target), strict=True):
        np.testing.assert_array_equal(alone.endpoints, beside.endpoints)
        np.testing.assert_array_equal(alone.descriptors, beside.descriptors)
    views = [
        PreparedView(make_view(cloud, found, settings.cloud_voxel_m), settings)
        for cloud, found in zip((source, target), lines, strict=True)
    ]
    alone = register_views(*views, settings)
    beside = register_lines(*lines, clouds=(source, target), settings=settings)
    assert alone.success
    np.testing.assert_array_equal(alone.T_target_source, beside.T_target_source)
    np.testing.assert_array_equal(alone.information, beside.information)


def test_no_kernel_runs_on_the_threads_of_numba():
    # its plainest threading layer aborts the process where two Python threads enter such kernels
    for path in Path(sl3d_slam.__file__).parent.rglob("*.py"):
        assert not re.search(r"\bparallel=|\bprange\b", path.read_text()), path

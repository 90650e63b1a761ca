"""Real scans that come back: out on the even scans, back on the odd ones with the sensor turned."""

import numpy as np
import pytest

from sl3d_slam import SlamPipeline, load_config
from sl3d_slam.bench.outback import out_and_back
from sl3d_slam.config import InputSettings, OdometrySettings
from sl3d_slam.geometry.se3 import distance_m, invert
from sl3d_slam.io.dataset import Dataset
from sl3d_slam.odometry.odometry import Odometry
from sl3d_slam.report.metrics import ate_rmse_m
from sl3d_slam.types import Scan


@pytest.fixture(scope="module")
def out_and_back_of(real_scans, shared):
    """Make a real drive that comes back, as a dataset, decoded once."""

    def make(name, num_scans):
        rows = np.loadtxt(shared / "data" / f"{name}.poses.txt").reshape(-1, 3, 4)
        truth = np.tile(np.eye(4), (num_scans, 1, 1))
        truth[:, :3] = rows[:num_scans]
        scans = real_scans(name, list(range(num_scans)))

        def read(start, stop):
            for index in range(start, stop):
                points = scans[index]
                ranges = np.linalg.norm(points, axis=1)
                yield Scan(index, 0.1 * index, points[(ranges > 2.0) & (ranges < 100.0)])

        return out_and_back(Dataset(name, f"drive {name}", num_scans, read, truth=truth))

    return make


@pytest.mark.data
@pytest.mark.slow
def test_a_street_driven_back_is_recognised_from_the_other_direction(out_and_back_of):
    drive = out_and_back_of("01", 108)
    slam = SlamPipeline(load_config())
    for scan in drive:
        slam.process(scan)
    run = slam.finish()
    accepted = [loop for loop in run.loops if loop.status == "accepted"]
    assert len(accepted) >= 3
    opposite = 0
    for loop in accepted:
        T_truth = invert(drive.truth[loop.target_scan]) @ drive.truth[loop.query_scan]
        assert distance_m(invert(T_truth) @ loop.T_target_query) < 2.0  # poses drift by metres in z
        opposite += T_truth[0, 0] < -0.5
    assert opposite >= 2
    truth = drive.truth
    poses, odometry = run.trajectory.T_world_lidar, run.odometry.T_world_lidar
    assert ate_rmse_m(poses, truth) < ate_rmse_m(odometry, truth) + 0.1


@pytest.mark.data
@pytest.mark.slow
def test_odometry_follows_a_sudden_turn_at_two_metres_a_scan(out_and_back_of):
    drive = out_and_back_of("02", 77)
    odometry = Odometry(OdometrySettings(), InputSettings())
    poses = np.array([odometry.register(scan).T_odom_lidar for scan in drive])
    # the given poses hold to about a metre here; an odometry that loses the turn is off by forty
    assert ate_rmse_m(poses, drive.truth) < 2.0

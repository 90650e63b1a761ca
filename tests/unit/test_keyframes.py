import numpy as np

from sl3d_slam.config import KeyframeSettings
from sl3d_slam.geometry.se3 import from_yaw
from sl3d_slam.keyframes import KeyframeSelector, starts_keyframe
from sl3d_slam.types import RegisteredScan

SETTINGS = KeyframeSettings(min_distance_m=2.0, min_rotation_deg=30.0)


def registered(index, T_odom_lidar):
    return RegisteredScan(index, 0.1 * index, np.zeros((1, 3)), T_odom_lidar)


def test_distance_and_rotation_each_suffice_whatever_the_frame():
    T_odom_last = from_yaw(2.0, np.array([40.0, -7.0, 1.0]))

    def moved(yaw_deg, x):
        return T_odom_last @ from_yaw(np.radians(yaw_deg), np.array([x, 0.0, 0.0]))

    assert not starts_keyframe(T_odom_last, moved(29.9, 1.99), SETTINGS)
    assert starts_keyframe(T_odom_last, moved(0.0, 2.01), SETTINGS)
    assert starts_keyframe(T_odom_last, moved(0.0, -2.01), SETTINGS)
    assert starts_keyframe(T_odom_last, moved(30.1, 0.0), SETTINGS)
    assert starts_keyframe(T_odom_last, moved(-30.1, 0.0), SETTINGS)


def test_distance_counts_from_the_last_keyframe_not_the_last_scan():
    selector = KeyframeSelector(SETTINGS)
    kept = []
    for index in range(10):  # 0.75 m a scan: every third one is 2.25 m from the one before
        pose = from_yaw(0.1, np.array([0.0, 0.75 * index, 0.0]))
        keyframe = selector.add(registered(index, pose))
        if keyframe is not None:
            kept.append(keyframe)
    assert [k.scan_index for k in kept] == [0, 3, 6, 9]
    assert [k.id for k in kept] == [0, 1, 2, 3]
    assert np.array_equal(kept[2].T_odom_lidar, from_yaw(0.1, np.array([0.0, 4.5, 0.0])))
    assert kept[2].stamp_s == 0.6000000000000001


def test_standing_still_gives_one_keyframe():
    selector = KeyframeSelector(SETTINGS)
    pose = from_yaw(1.0, np.array([5.0, 5.0, 0.0]))
    assert [selector.add(registered(i, pose)) is None for i in range(4)] == [
        False,
        True,
        True,
        True,
    ]

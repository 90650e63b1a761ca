"""Ray casting against shapes whose answer is known by hand."""

import numba
import numpy as np
import pytest

from sl3d_slam.geometry.se3 import from_yaw, make_transform
from sl3d_slam.simulation.ground import SENSOR_HEIGHT_M, Ground
from sl3d_slam.simulation.primitives import Material, SceneBuilder, Semantic, Windows
from sl3d_slam.simulation.scene import build_scene, cast_scan
from sl3d_slam.simulation.sensor import Sensor
from sl3d_slam.types import LineKind

WALL = Material(Semantic.BUILDING, 0.6)
STEEL = Material(Semantic.POLE, 0.9)
UP = np.array([0.0, 0.0, 1.0])


def flat_ground(slope_x=0.0, road_edge_y=None):
    """Return 120 m x 120 m around the origin, at z = -1.73 there; the road is y < road_edge_y."""
    x, y = np.meshgrid(np.arange(-60.0, 61.0), np.arange(-60.0, 61.0))
    distance = np.full_like(x, -50.0) if road_edge_y is None else y - road_edge_y
    height = -SENSOR_HEIGHT_M + slope_x * x
    grid = np.stack([height, distance, np.full_like(x, 0.12), np.full_like(x, 3.0)], axis=2)
    return Ground(np.array([-60.0, -60.0]), 1.0, grid.astype(np.float32))


def perfect(elevations_deg, steps):
    return Sensor("test", np.radians(elevations_deg), steps, 0.1, 120.0, 0.0, 0.0, 0.0)


def cast(builder, elevations_deg=(0.0,), steps=3600, ground=None, T=None):
    ground = flat_ground() if ground is None else ground
    scene = build_scene(ground, [builder.primitives()])
    T = np.eye(4) if T is None else T
    return cast_scan(scene, T, perfect(elevations_deg, steps), 0, 7)


def ahead(scan, tolerance=1e-3):
    """Return the points of a scan nearest to straight ahead."""
    return scan.points_lidar[np.abs(np.arctan2(*scan.points_lidar.T[1::-1])) < tolerance]


def test_a_turned_box_is_hit_on_its_near_corner():
    builder = SceneBuilder()
    builder.box((10.0, 0.0, 0.0), np.pi / 4, (1.0, 1.0, 3.0), WALL)
    scan = cast(builder)
    # the nearest corner of a square of half side 1, turned by 45 deg, is sqrt(2) from its centre
    assert scan.points_lidar[:, 0].min() == pytest.approx(10.0 - np.sqrt(2.0), abs=0.02)
    assert (scan.labels == Semantic.BUILDING).all()


def test_a_pole_is_hit_on_its_mantle_and_belongs_to_its_line():
    builder = SceneBuilder()
    foot, top = np.array([0.0, 8.0, -2.0]), np.array([0.0, 8.0, 4.0])
    line = builder.line(foot, top, LineKind.POLE, Semantic.POLE)
    builder.cylinder(foot, top, 0.2, STEEL, line)
    scan = cast(builder, elevations_deg=(10.0, 0.0))
    radius = np.linalg.norm(scan.points_lidar[:, :2] - [0.0, 8.0], axis=1)
    np.testing.assert_allclose(radius, 0.2, atol=1e-6)
    assert (scan.line_ids == line).all()
    assert len(scan.points_lidar) > 40  # 0.4 m at 8 m are 28 steps of 0.1 deg in each beam


def test_the_ground_is_where_a_slope_says():
    scan = cast(SceneBuilder(), elevations_deg=(-10.0,), ground=flat_ground(slope_x=0.08))
    # z = -1.73 + 0.08 x meets z = -tan(10 deg) x
    expected_x = SENSOR_HEIGHT_M / (np.tan(np.radians(10.0)) + 0.08)
    assert ahead(scan)[:, 0] == pytest.approx(expected_x, abs=0.02)
    heights = -SENSOR_HEIGHT_M + 0.08 * scan.points_lidar[:, 0]
    # 5 mm: the solver stops at 1 mm of height, the road's own roughness is 2 mm along the ray
    np.testing.assert_allclose(scan.points_lidar[:, 2], heights, atol=5e-3)


def test_the_pavement_is_a_kerb_higher_than_the_road():
    ground = flat_ground(road_edge_y=5.3)
    scan = cast(SceneBuilder(), elevations_deg=np.arange(-24.0, -8.0, 0.5), ground=ground)
    y, z = scan.points_lidar[:, 1], scan.points_lidar[:, 2]
    assert z[y > 5.4].mean() - z[y < 5.2].mean() == pytest.approx(0.12, abs=0.01)
    assert set(scan.labels[y < 5.2]) == {Semantic.ROAD}
    assert set(scan.labels[(y > 5.4) & (y < 7.0)]) == {Semantic.SIDEWALK}


def test_what_is_nearer_hides_what_is_behind_whatever_the_order():
    near, far = ((6.0, 0.0, 0.0), (0.5, 2.0, 2.0)), ((9.0, 0.0, 0.0), (0.5, 2.0, 2.0))
    for order in ((near, far), (far, near)):
        builder = SceneBuilder()
        for centre, half in order:
            builder.box(centre, 0.0, half, WALL)
        np.testing.assert_allclose(ahead(cast(builder))[:, 0], 5.5, atol=1e-6)


def test_points_are_in_the_frame_of_a_sensor_that_moved_and_turned():
    builder = SceneBuilder()
    builder.box((10.0, 20.0, 0.0), 0.0, (1.0, 1.0, 3.0), WALL)
    T_town_lidar = from_yaw(np.pi / 2, np.array([10.0, 5.0, 0.5]))  # looks along +y, at the box
    scan = cast(builder, T=T_town_lidar)
    builder.box((7.0, 12.0, 0.0), 0.0, (0.5, 0.5, 3.0), WALL)  # 7 m ahead, 3 m to the left
    left = cast(builder, T=T_town_lidar).points_lidar
    left = left[left[:, 0] < 8.0]
    np.testing.assert_allclose([left[:, 0].min(), left[:, 1].min()], [6.5, 2.5], atol=0.03)
    # the near face is at y = 19, 14 m ahead
    np.testing.assert_allclose(ahead(scan)[:, 0], 14.0, atol=1e-5)


def test_the_edge_of_two_walls_owns_the_points_beside_it_on_both():
    builder = SceneBuilder()
    corner = np.array([8.0, 0.0, -2.0])
    edge = builder.line(corner, corner + 5 * UP, LineKind.VERTICAL_EDGE, Semantic.BUILDING)
    for u in (np.array([3.0, 3.0, 0.0]), np.array([3.0, -3.0, 0.0])):
        builder.patch((corner, u, 5 * UP), WALL, edges=(edge, -1, -1, -1))
    scan = cast(builder)
    distance = np.linalg.norm(scan.points_lidar[:, :2] - corner[:2], axis=1)
    np.testing.assert_array_equal(scan.line_ids == edge, distance < 0.13)
    assert (scan.points_lidar[scan.line_ids == edge, 1] > 0).any()
    assert (scan.points_lidar[scan.line_ids == edge, 1] < 0).any()


def test_a_gable_is_a_triangle():
    builder = SceneBuilder()
    builder.patch(((10.0, -4.0, -1.0), (0.0, 8.0, 0.0), (0.0, 0.0, 4.0)), WALL, taper=1.0)
    scan = cast(builder, elevations_deg=np.arange(-5.0, 16.0, 1.0))
    wall = scan.points_lidar[scan.labels == Semantic.BUILDING]
    # half width 4 at z = -1 shrinks to 0 at z = 3
    assert (np.abs(wall[:, 1]) <= 4.0 - (wall[:, 2] + 1.0) + 1e-6).all()
    assert np.abs(wall[:, 1]).max() > 3.5


def test_windows_are_behind_the_wall_and_some_let_rays_in():
    builder = SceneBuilder()
    windows = Windows(3.0, 1.4, 3.0, 1.6, 0.2)
    builder.patch(((9.0, -15.0, -1.7), (0.0, 30.0, 0.0), 9.0 * UP), WALL, windows=windows)
    scan = cast(builder, elevations_deg=np.arange(0.0, 30.0, 2.0))
    depth = scan.points_lidar[:, 0] - 9.0
    assert 0.5 < (np.abs(depth) < 1e-6).mean() < 0.9
    assert (np.abs(depth - 0.2) < 1e-6).sum() > 200
    assert ((depth > 0.21) & (depth < 4.3)).sum() > 50
    assert depth.min() > -1e-6


def test_foliage_stops_rays_after_the_depth_that_its_density_says():
    builder = SceneBuilder()
    builder.box((15.0, 0.0, 0.0), 0.0, (5.0, 8.0, 9.0), Material(Semantic.VEGETATION, 0.6, 2.0))
    scan = cast(builder, elevations_deg=np.arange(0.0, 20.0, 1.0))
    front = np.abs(scan.points_lidar[:, 1] / scan.points_lidar[:, 0]) < 0.3
    points = scan.points_lidar[front]
    inside = np.linalg.norm(points, axis=1) * (1.0 - 10.0 / points[:, 0])
    assert inside.min() > 0.0
    # an exponential law of mean 1 / 2 m; 4 standard errors
    assert inside.mean() == pytest.approx(0.5, abs=4 * 0.5 / np.sqrt(len(inside)))


def test_the_number_of_threads_changes_nothing(monkeypatch):
    builder = SceneBuilder()
    builder.ellipsoid((8.0, 1.0, 0.0), (2.0, 3.0, 2.0), Material(Semantic.VEGETATION, 0.5, 1.5))
    builder.box((20.0, 0.0, 0.0), 0.3, (1.0, 9.0, 5.0), WALL)
    scene = build_scene(flat_ground(), [builder.primitives()])
    tilted = make_transform(from_yaw(0.4, np.zeros(3))[:3, :3], np.array([1.0, 2.0, 0.0]))
    sensor = Sensor("noisy", np.radians([-8.0, -2.0, 0.0, 4.0]), 1000)
    scans = []
    for threads in (1, 2, 7):
        monkeypatch.setattr(numba.config, "NUMBA_NUM_THREADS", threads)
        scans.append(cast_scan(scene, tilted, sensor, 3, 11))
    for scan in scans[1:]:
        np.testing.assert_array_equal(scan.points_lidar, scans[0].points_lidar)
        np.testing.assert_array_equal(scan.intensities, scans[0].intensities)


def test_range_noise_has_the_sigma_of_the_sensor():
    builder = SceneBuilder()
    builder.patch(((10.0, -20.0, -1.7), (0.0, 40.0, 0.0), 20.0 * UP), WALL)
    sensor = Sensor("noisy", np.radians(np.arange(2.0, 40.0)), 2000, lost_share=0.0)
    scene = build_scene(flat_ground(), [builder.primitives()])
    points = cast_scan(scene, np.eye(4), sensor, 0, 5).points_lidar
    points = points[points[:, 0] > 5.0]
    ranges = np.linalg.norm(points, axis=1)
    error = ranges * (1.0 - 10.0 / points[:, 0])  # along the ray, from the plane x = 10
    # 20,000 rays: the deviation is known to half a per cent, the mean to 0.15 mm
    assert error.std() == pytest.approx(0.02, rel=0.03)
    assert abs(error.mean()) < 0.001

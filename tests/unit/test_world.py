"""A drive held to GPS and gravity: the frame is found, drift goes, outliers do not count."""

from dataclasses import replace
from itertools import pairwise

import gtsam
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sl3d_slam.config import GraphSettings, WorldSettings
from sl3d_slam.errors import GraphError
from sl3d_slam.geometry.geodesy import GeoOrigin, enu_from_geodetic
from sl3d_slam.geometry.se3 import (
    exp,
    invert,
    log,
    make_transform,
    rotation_angle_rad,
    transform_points,
)
from sl3d_slam.graph.final import marginal_covariances, optimise_all_scans
from sl3d_slam.graph.fixes import attach_positions, position_fixes, up_fixes
from sl3d_slam.graph.g2o import read_g2o
from sl3d_slam.graph.solve import optimise
from sl3d_slam.graph.world import place_in_world, prior_of
from sl3d_slam.types import PositionFixes, Trajectory, UpFixes, WorldMeasurements

GRAPH = GraphSettings(odometry_rotation_sigma_deg=0.1, odometry_translation_sigma_m=0.02)
LEVER = np.array([-0.8, 0.3, 0.6])
WORLD = WorldSettings(antenna_x_m=LEVER[0], antenna_y_m=LEVER[1], antenna_z_m=LEVER[2])
T_ENU_MAP = make_transform(
    Rotation.from_euler("zyx", [131.0, 0.0, 0.0], degrees=True).as_matrix(),
    np.array([40.0, -25.0, 3.0]),
)
UP = np.array([0.0, 0.0, 1.0])


def drive(num_scans=240):
    """A bend of some 230 m with a hill, the first pose the identity."""
    t = np.arange(num_scans)
    yaw, pitch = 0.010 * t, 0.03 * np.sin(t / 30.0)
    R = Rotation.from_euler("zy", np.column_stack([yaw, pitch])).as_matrix()
    steps = np.einsum("nij,j->ni", R, [1.0, 0.0, 0.0])
    poses = np.tile(np.eye(4), (num_scans, 1, 1))
    poses[:, :3, :3] = R
    poses[:, :3, 3] = np.cumsum(steps, axis=0) - steps[0]
    return np.array([invert(poses[0]) @ pose for pose in poses])


def drifting(truth, rng):
    """Odometry with white noise and a turn rate that is off: some ten metres at the end."""
    poses = [truth[0]]
    for before, after in pairwise(truth):
        noise = exp(np.r_[0, np.radians(-0.02), np.radians(0.04), 0.01 * rng.standard_normal(3)])
        poses.append(poses[-1] @ invert(before) @ after @ noise)
    return np.array(poses)


@pytest.fixture
def world(rng):
    """Truth, odometry as solved graph, and GPS at 2 Hz between scans, every sixth far off."""
    truth = drive()
    stamps = 0.1 * np.arange(len(truth)) + 5.0
    odometry = Trajectory(stamps, drifting(truth, rng))
    final = optimise_all_scans(odometry.T_world_lidar, {}, {}, [], GRAPH)
    at = np.arange(2, len(truth) - 3, 5)
    T_enu_mid = [T_ENU_MAP @ truth[k] @ exp(0.5 * log(invert(truth[k]) @ truth[k + 1])) for k in at]
    antennas = np.array([transform_points(T, LEVER[None])[0] for T in T_enu_mid])
    measured = antennas + rng.normal(0.0, 0.5, antennas.shape)
    wrong = np.arange(len(at)) % 6 == 3
    measured[wrong] += rng.normal(0.0, 40.0, (int(wrong.sum()), 3))
    fixes = PositionFixes(stamps[at] + 0.05, measured, np.full_like(measured, 0.5))
    return truth, odometry, final, fixes, wrong


def rms_m(poses, truth):
    return float(np.sqrt(((poses[:, :3, 3] - truth[:, :3, 3]) ** 2).sum(axis=1).mean()))


def test_gps_with_outliers_takes_the_drift_out_and_finds_the_frame(world):
    truth, odometry, final, fixes, wrong = world
    placed = place_in_world(final, odometry, WorldMeasurements(fixes), WORLD)
    in_enu = placed.T_world_map @ placed.graph.T_world_lidar
    drift_m = rms_m(T_ENU_MAP @ final.T_world_lidar, T_ENU_MAP @ truth)
    assert drift_m > 3.0
    # 40 honest fixes of 0.5 m on an axis over a chain that bends by centimetres
    assert rms_m(in_enu, T_ENU_MAP @ truth) < 0.5
    assert abs(placed.num_used - int((~wrong).sum())) <= 1
    difference = invert(T_ENU_MAP) @ placed.T_world_map
    assert np.linalg.norm(difference[:3, 3]) < 1.0
    assert np.degrees(np.arctan2(difference[1, 0], difference[0, 0])) == pytest.approx(0.0, abs=1.5)
    assert np.degrees(rotation_angle_rad(difference)) < 4.0  # a drive hardly tells its roll
    np.testing.assert_allclose(placed.graph.T_world_lidar[0], odometry.T_world_lidar[0], atol=1e-9)


def test_the_antennas_place_matters(world):
    truth, odometry, final, fixes, _ = world
    bare = place_in_world(final, odometry, WorldMeasurements(fixes), WorldSettings())
    known = place_in_world(final, odometry, WorldMeasurements(fixes), WORLD)
    errors = [
        rms_m(placed.T_world_map @ placed.graph.T_world_lidar, T_ENU_MAP @ truth)
        for placed in (bare, known)
    ]
    assert errors[0] > errors[1] + 0.3  # the lever arm is a metre


def test_gravity_takes_the_tilt_out(world, rng):
    truth, odometry, final, _, _ = world
    T_level_map = make_transform(Rotation.from_euler("yx", [0.05, -0.03]).as_matrix(), np.zeros(3))
    ups = np.array([(T_level_map @ pose)[:3, :3].T @ UP for pose in truth])
    ups[::9] = [0.0, 0.6, 0.8]  # a bend taken fast
    ups += rng.normal(0.0, 0.003, ups.shape)
    ups /= np.linalg.norm(ups, axis=1, keepdims=True)
    fixes = UpFixes(odometry.stamps_s, ups, np.full(len(ups), 0.005))
    placed = place_in_world(final, odometry, WorldMeasurements(None, fixes), WORLD)
    tilt = [
        np.degrees(np.arccos(np.clip((T_level_map @ a)[2, :3] @ (b @ c)[2, :3], -1, 1)))
        for a, b, c in (
            (truth[-1], T_level_map, final.T_world_lidar[-1]),
            (truth[-1], placed.T_world_map, placed.graph.T_world_lidar[-1]),
        )
    ]
    assert tilt[0] > 2.0
    assert tilt[1] < 0.2
    assert placed.num_used == len(ups) - len(ups[::9])


def test_the_graph_file_reopens_to_the_same_poses(world, tmp_path):
    _, odometry, final, fixes, _ = world
    graph = place_in_world(final, odometry, WorldMeasurements(fixes), WORLD).graph
    (tmp_path / "graph.g2o").write_text(graph.to_g2o())
    reopened = read_g2o(tmp_path / "graph.g2o")
    assert not reopened.fixed
    _, values = optimise(reopened.poses, reopened.edges, reopened.priors)
    again = np.array([values.atPose3(k).matrix() for k in range(len(graph.poses))])
    assert np.abs(again - graph.T_world_lidar).max() < 1e-6  # priors pull as the fixes do


def test_covariances_are_those_of_the_world(world):
    _, odometry, final, fixes, _ = world
    graph = place_in_world(final, odometry, WorldMeasurements(fixes), WORLD).graph
    sigmas = np.sqrt(np.linalg.eigvalsh(marginal_covariances(graph, [0, 120, 239])[:, 3:, 3:]))
    assert sigmas[0].max() > 0.05  # the first scan is as uncertain as the others: no anchor
    assert sigmas.max() < 1.0


def test_every_factor_has_the_slope_of_its_error(rng):
    """Numeric derivatives, at poses and levers that are not their own inverse."""
    odometry = Trajectory(np.array([0.0, 0.1]), np.array([np.eye(4), exp(np.full(6, 0.1))]))
    fixes = PositionFixes(np.array([0.04]), np.array([[5.0, 6.0, 7.0]]), np.full((1, 3), 0.7))
    ups = UpFixes(np.array([0.04]), np.array([[0.6, 0.0, 0.8]]), np.array([0.02]))
    factors = position_fixes(attach_positions(fixes, odometry, WORLD), WORLD)
    factors += up_fixes(ups, odometry, WORLD)
    T_world_lidar = exp(np.array([0.3, -0.2, 0.9, 4.0, 5.0, 6.0]))
    for fix in factors:
        values = gtsam.Values()
        values.insert(0, gtsam.Pose3(T_world_lidar))
        A, _ = fix.honest.linearize(values).jacobian()

        def whitened(step, factor=fix.honest):
            moved = gtsam.Values()
            moved.insert(0, gtsam.Pose3(T_world_lidar @ exp(step)))
            return factor.noiseModel().whiten(factor.unwhitenedError(moved))

        slopes = [(whitened(1e-6 * e) - whitened(-1e-6 * e)) / 2e-6 for e in np.eye(6)]
        np.testing.assert_allclose(A, np.array(slopes).T, atol=1e-4 * np.abs(A).max())


def test_the_antenna_is_carried_to_the_scan_before_the_fix():
    """By hand: half-way through a metre forwards, the antenna is half a metre further ahead."""
    poses = np.array([np.eye(4), make_transform(np.eye(3), np.array([1.0, 0, 0]))])
    fixes = PositionFixes(np.array([0.05]), np.zeros((1, 3)), np.ones((1, 3)))
    attached = attach_positions(fixes, Trajectory(np.array([0.0, 0.1]), poses), WORLD)
    assert attached.scans.tolist() == [0]
    np.testing.assert_allclose(attached.antennas[0], LEVER + np.array([0.5, 0.0, 0.0]), atol=1e-12)


def test_a_prior_pulls_as_its_factor_does(world):
    _, odometry, final, fixes, _ = world
    fix = position_fixes(attach_positions(fixes, odometry, WORLD), WORLD)[0]
    values = gtsam.Values()
    values.insert(fix.scan, gtsam.Pose3(T_ENU_MAP @ final.T_world_lidar[fix.scan]))
    prior = prior_of(fix.honest, fix.scan, T_ENU_MAP @ final.T_world_lidar[fix.scan], values)
    A, b = fix.honest.linearize(values).jacobian()
    T_enu_lidar = T_ENU_MAP @ final.T_world_lidar[fix.scan]
    pull = prior.information @ log(invert(T_enu_lidar) @ prior.T_world_key)
    np.testing.assert_allclose(pull, A.T @ b, atol=1e-3 * np.abs(A.T @ b).max())


def test_what_cannot_be_placed_is_said(world):
    _, odometry, final, fixes, _ = world
    late = replace(fixes, stamps_s=fixes.stamps_s + 1e9)
    with pytest.raises(GraphError, match="expected one clock"):
        place_in_world(final, odometry, WorldMeasurements(late), WORLD)
    vague = replace(fixes, sigmas_m=np.full_like(fixes.sigmas_m, 300.0))
    with pytest.raises(GraphError, match="do not tell the map's heading"):
        place_in_world(final, odometry, WorldMeasurements(vague), WORLD)
    scattered = replace(
        fixes, positions_enu=np.random.default_rng(1).normal(0, 200, fixes.positions_enu.shape)
    )
    with pytest.raises(GraphError, match="fit the drive"):
        place_in_world(final, odometry, WorldMeasurements(scattered), WORLD)


def test_east_and_north_are_east_and_north():
    """A degree of latitude at 49 degrees is 111,213 m, one of longitude 73,173 m (WGS84 tables)."""
    origin = GeoOrigin(49.0, 8.4, 115.0)
    lat, lon = np.array([49.0, 49.0005, 49.0]), np.array([8.4, 8.4, 8.401])
    enu = enu_from_geodetic(lat, lon, np.array([115.0, 115.0, 125.0]), origin)
    np.testing.assert_allclose(enu[0], 0.0, atol=1e-9)
    assert enu[1, 1] == pytest.approx(111_213 * 5e-4, rel=1e-3)
    assert enu[2, 0] == pytest.approx(73_173 * 1e-3, rel=1e-3)
    assert enu[2, 2] == pytest.approx(10.0, abs=0.01)

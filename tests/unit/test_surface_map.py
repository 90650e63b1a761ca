"""Surfaces laid on a map: the equations against a plain oracle, traffic, wrong leads."""

import numpy as np
import pytest
import small_gicp

from sl3d_slam.geometry import surface_fit
from sl3d_slam.geometry.gaussian_voxels import FLATNESS, GaussianVoxels, Surfaces
from sl3d_slam.geometry.robust_gicp import normal_equations
from sl3d_slam.geometry.se3 import distance_m, exp, invert, rotation_angle_rad, transform_points
from sl3d_slam.odometry.surface_map import SurfaceMap
from sl3d_slam.odometry.surfaces import surfaces_of

POSE = exp(np.array([0.02, -0.05, 0.9, 40.0, -25.0, 3.0]))
STEP = exp(np.array([0.003, -0.004, 0.02, 0.9, 0.05, 0.02]))
WIDTH = 0.7


def random_planes(rng, count=30):
    """Return (V, 3) means and normals of voxels of a metre, none sharing one."""
    corners = rng.permutation(
        np.stack(np.meshgrid(*[np.arange(-3, 3)] * 3), axis=-1).reshape(-1, 3)
    )
    means = corners[:count] + rng.uniform(0.2, 0.8, (count, 3))
    return means, unit_vectors(rng, count)


def unit_vectors(rng, count):
    vectors = rng.standard_normal((count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def oracle(points, normals, means, covariances, pose, width):
    """Return what the equations say, J by differences, and the robust cost of a step from there."""
    rows, infos = [], []
    for p, n in zip(points, normals, strict=True):
        cell = np.floor(pose[:3, :3] @ p + pose[:3, 3])
        (found,) = np.nonzero((np.floor(means[:, :3]) == cell).all(axis=1))
        rows.append(int(found[0]) if len(found) else -1)
        turned = pose[:3, :3] @ n
        spread = np.eye(3) - FLATNESS * np.outer(turned, turned)
        infos.append(np.linalg.inv(covariances[rows[-1]] + spread))
    met = [k for k, row in enumerate(rows) if row >= 0]

    def residual(k, step):
        moved = pose @ exp(step)
        return means[rows[k], :3] - moved[:3, :3] @ points[k] - moved[:3, 3]

    def robust_cost(step):
        errors = np.array([residual(k, step) @ infos[k] @ residual(k, step) for k in met])
        return float((0.5 * width * errors / (width + errors)).sum())

    steps = 1e-6 * np.eye(6)
    hessian, weights, costs = np.zeros((6, 6)), [], []
    for k in met:
        J = np.array([(residual(k, s) - residual(k, -s)) / 2e-6 for s in steps]).T
        error = residual(k, np.zeros(6)) @ infos[k] @ residual(k, np.zeros(6))
        weights.append((width / (width + error)) ** 2)
        costs.append(weights[-1] * error)
        hessian += weights[-1] * J.T @ infos[k] @ J
    gradient = np.array([(robust_cost(s) - robust_cost(-s)) / 2e-6 for s in steps])
    return hessian, gradient, sum(costs), sum(weights), len(met)


def test_equations_are_the_derivatives_of_the_robust_cost(rng):
    means, map_normals = random_planes(rng)
    covariances = [np.eye(3) - FLATNESS * np.outer(normal, normal) for normal in map_normals]
    on_map = means[rng.integers(0, len(means), 60)] + 0.3 * rng.standard_normal((60, 3))
    points, normals = transform_points(invert(POSE), on_map), unit_vectors(rng, 60)
    voxels = GaussianVoxels()
    voxels.insert(Surfaces(means, map_normals), np.eye(4))
    found = normal_equations(points, normals, voxels.rows, POSE, WIDTH)
    hessian, gradient, cost, weight, met = oracle(points, normals, means, covariances, POSE, WIDTH)
    assert 20 < met < 60  # and some fall into no voxel
    np.testing.assert_allclose(found[0], hessian, rtol=1e-5, atol=1e-5 * np.abs(hessian).max())
    np.testing.assert_allclose(found[1], gradient, rtol=1e-4, atol=1e-5 * np.abs(gradient).max())
    np.testing.assert_allclose(found[2:], (cost, weight), rtol=1e-9)


POLES = np.random.default_rng(0).uniform([-30, 7], [60, 8], (12, 2))


def street(T_world_lidar, rng, cars_at=None):
    """Return a scan of ground, poles and houses of other depths, and of cars about the lidar."""
    ground = np.column_stack([rng.uniform([-40, -6], [80, 6], (9000, 2)), np.zeros(9000)])
    x, deep = rng.uniform(-40, 80, 6000), rng.uniform(9.0, 10.5, 2000)
    fronts = np.column_stack([x, 9.0 + 1.5 * (np.floor(x / 5.0) % 2)])
    flanks = np.column_stack([5.0 * rng.integers(-8, 16, 2000), deep])
    poles = POLES[rng.integers(0, 12, 800)] + 0.1 * unit_vectors(rng, 800)[:, :2]
    houses = np.vstack([fronts, flanks]) * rng.choice([[1, 1], [1, -1]], 8000)
    plan = np.vstack([houses, poles])
    standing = np.column_stack([plan, rng.uniform(0, 6, len(plan))])
    seen = transform_points(invert(T_world_lidar), np.vstack([ground, standing]) - [0, 0, 1.7])
    if cars_at is not None:
        seen = np.vstack([seen, transform_points(cars_at, cars(rng))])
    return seen + rng.normal(0, 0.015, seen.shape)


def cars(rng):
    """Return the sides and backs of six cars ahead and behind, a tenth of a scan."""
    around = np.array([[x, y] for x in (-14.0, 8.0, 16.0) for y in (-3.5, 3.5)])
    place = around[rng.integers(0, len(around), 1800)]
    side = rng.random(1800) < 0.5
    along, across = rng.uniform(-2, 2, 1800), rng.uniform(-0.9, 0.9, 1800)
    along[side], across[~side] = np.where(side, along, -2.0)[side], across[~side]
    body = np.column_stack([np.where(side, along, -2.0), np.where(side, -0.9, across)])
    return np.column_stack([place + body, rng.uniform(-1.5, -0.2, 1800)])


def step_into_traffic(rng):
    """Return the pose found after ten scans among cars that drive at nearly the lidar's pace."""
    surfaces, pose, slip = SurfaceMap(), POSE, exp(np.array([0, 0, 0, 0.15, 0, 0]))
    cars_at = np.eye(4)
    for _ in range(10):
        surfaces.insert(surfaces_of(street(invert(POSE) @ pose, rng, cars_at)), pose)
        pose, cars_at = pose @ STEP, cars_at @ slip
    seen = surfaces_of(street(invert(POSE) @ pose, rng, cars_at))
    return invert(pose) @ surfaces.align(seen, pose).fit.T_target_source


def test_cars_that_drive_along_do_not_pull(monkeypatch):
    robust = distance_m(step_into_traffic(np.random.default_rng(1)))
    monkeypatch.setattr(surface_fit, "LAST_WIDTH", 1e9)
    monkeypatch.setattr(surface_fit, "FIRST_WIDTH", 1e9)
    pulled = distance_m(step_into_traffic(np.random.default_rng(1)))
    # noise of 15 mm on thousands of points leaves millimetres; without a kernel, cars centimetres
    assert robust < 0.006
    assert pulled > 3 * robust


@pytest.mark.parametrize("lead", [(0.3, 0, 0, 0), (-0.2, 0.15, 0.1, 0.5), (0.0, -0.2, 0, -1.0)])
def test_a_lead_some_decimetres_off_is_put_right(lead, rng):
    surfaces = SurfaceMap()
    surfaces.insert(surfaces_of(street(np.eye(4), rng)), POSE)
    true = POSE @ STEP
    led = true @ exp(np.array([0, 0, np.radians(lead[3]), *lead[:3]]))
    found = surfaces.align(surfaces_of(street(STEP, rng)), led)
    T_map_lidar = found.fit.T_target_source
    error = invert(true) @ T_map_lidar
    assert distance_m(error) < 0.02
    assert rotation_angle_rad(error) < np.radians(0.1)
    moved_m = distance_m(invert(led) @ T_map_lidar)
    assert found.settled == (moved_m < 0.2)


def test_surfaces_that_meet_nothing_stay_where_they_were_led(rng):
    surfaces = SurfaceMap()
    surfaces.insert(surfaces_of(street(np.eye(4), rng)), POSE)
    far = POSE @ exp(np.array([0, 0, 0, 0, 500.0, 0]))
    found = surfaces.align(surfaces_of(street(np.eye(4), rng)), far)
    np.testing.assert_allclose(found.fit.T_target_source, far, atol=1e-9)
    assert not found.settled
    assert (found.fit.misfit, found.fit.support) == (0.0, 0.0)


def test_voxels_are_those_that_small_gicp_keeps(rng):
    """Over sixty scans of a drive, means, covariances and what has been forgotten."""
    ours, theirs = GaussianVoxels(memory=25), small_gicp.GaussianVoxelMap(1.0)
    theirs.set_lru(horizon=25, clear_cycle=10)
    pose, sizes = POSE, []
    for _ in range(60):
        scan = street(invert(POSE) @ pose, rng)
        cloud, _ = small_gicp.preprocess_points(scan, 0.5, num_threads=1)
        ours.insert(Surfaces.of(cloud), pose)
        theirs.insert(cloud, pose)
        pose = pose @ STEP
        sizes.append(len(ours))
    assert len(ours) == theirs.size()
    assert sizes[-1] < max(sizes)
    means = theirs.voxel_points()[:, :3]
    covariances = np.array(theirs.voxel_covs()).reshape(-1, 4, 4)[:, :3, :3]
    order, expected = (np.lexsort(m.T) for m in (ours.rows.means[: len(ours)], means))
    np.testing.assert_allclose(ours.rows.means[order], means[expected], atol=1e-9)
    row, column = np.triu_indices(3)
    upper = covariances[expected][:, row, column]
    np.testing.assert_allclose(ours.rows.covariances[order], upper, atol=1e-9)

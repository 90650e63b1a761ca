"""The normal equations of generalised ICP against voxels, with a robust kernel; compiled.

Cost of a point p with normal n that falls into a voxel with mean m and covariance C: e = r' M r
with r = m - T p and M = (C + R A R')^-1, where A = I - (1 - f) n n' is a plane's covariance, as in
:mod:`gaussian_voxels`. Its weight is (w / (w + e))^2, Geman and McClure's, of width w.
"""

from typing import no_type_check

import numpy as np
from numba import njit

from sl3d_slam.geometry.gaussian_voxels import FLATNESS, VOXEL_M, Voxels
from sl3d_slam.geometry.voxel_table import slot_of, voxel_key


@njit(cache=True, nogil=True)
@no_type_check
def normal_equations(
    points: np.ndarray,
    normals: np.ndarray,
    voxels: Voxels,
    T_map_lidar: np.ndarray,
    width: float,
) -> tuple[np.ndarray, np.ndarray, float, float]:
    """Return Hessian (6, 6), gradient (6,), sum of weighted costs, sum of weights.

    Of a step that ``exp`` takes at the lidar's frame, rotation first; (N, 3) points and normals are
    in that frame, the voxels in the map's.
    """
    R, t = T_map_lidar[:3, :3], T_map_lidar[:3, 3]
    system = np.zeros((6, 7))  # Hessian and gradient
    a, n, r, u = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    M, SM = np.empty((3, 3)), np.empty((3, 3))
    cost, total = 0.0, 0.0
    for i in range(len(points)):
        _turn(R, points[i], a)
        key = voxel_key(a[0] + t[0], a[1] + t[1], a[2] + t[2], VOXEL_M)
        row = voxels.table[slot_of(voxels.table, voxels.keys, key)]
        if row < 0:
            continue
        _turn(R, normals[i], n)
        _information(voxels.covariances[row], n, M)
        for k in range(3):
            r[k] = voxels.means[row, k] - a[k] - t[k]
        _turn(M, r, u)
        error = r[0] * u[0] + r[1] * u[1] + r[2] * u[2]
        weight = (width / (width + error)) ** 2
        cost += weight * error
        total += weight
        _add(a, M, u, weight, SM, system)
    hessian, gradient = _in_lidar_frame(R, system)
    return hessian, gradient, cost, total


@njit(cache=True, nogil=True, inline="always")
@no_type_check
def _turn(R: np.ndarray, v: np.ndarray, out: np.ndarray) -> None:
    for k in range(3):
        out[k] = R[k, 0] * v[0] + R[k, 1] * v[1] + R[k, 2] * v[2]


@njit(cache=True, nogil=True, inline="always")
@no_type_check
def _information(covariance: np.ndarray, n: np.ndarray, M: np.ndarray) -> None:
    """Write ``(C + I - FLATNESS n n')^-1`` by its cofactors; C is given by its upper triangle."""
    c00 = covariance[0] + 1.0 - FLATNESS * n[0] * n[0]
    c01 = covariance[1] - FLATNESS * n[0] * n[1]
    c02 = covariance[2] - FLATNESS * n[0] * n[2]
    c11 = covariance[3] + 1.0 - FLATNESS * n[1] * n[1]
    c12 = covariance[4] - FLATNESS * n[1] * n[2]
    c22 = covariance[5] + 1.0 - FLATNESS * n[2] * n[2]
    m00, m01, m02 = c11 * c22 - c12 * c12, c02 * c12 - c01 * c22, c01 * c12 - c02 * c11
    scale = 1.0 / (c00 * m00 + c01 * m01 + c02 * m02)
    M[0, 0], M[0, 1], M[0, 2] = m00 * scale, m01 * scale, m02 * scale
    M[1, 1] = (c00 * c22 - c02 * c02) * scale
    M[1, 2] = (c01 * c02 - c00 * c12) * scale
    M[2, 2] = (c00 * c11 - c01 * c01) * scale
    M[1, 0], M[2, 0], M[2, 1] = M[0, 1], M[0, 2], M[1, 2]


@njit(cache=True, nogil=True, inline="always")
@no_type_check
def _add(
    a: np.ndarray, M: np.ndarray, u: np.ndarray, weight: float, SM: np.ndarray, system: np.ndarray
) -> None:
    """Add a point's share in the map's axes about the lidar: J = [S, -I] with S v = a x v."""
    for k in range(3):  # S M, column by column
        SM[0, k] = weight * (a[1] * M[2, k] - a[2] * M[1, k])
        SM[1, k] = weight * (a[2] * M[0, k] - a[0] * M[2, k])
        SM[2, k] = weight * (a[0] * M[1, k] - a[1] * M[0, k])
    for k in range(3):  # S M S', row by row, as S v' = a x v
        system[k, 0] += a[1] * SM[k, 2] - a[2] * SM[k, 1]
        system[k, 1] += a[2] * SM[k, 0] - a[0] * SM[k, 2]
        system[k, 2] += a[0] * SM[k, 1] - a[1] * SM[k, 0]
        for j in range(3):
            system[k, 3 + j] += SM[k, j]
            system[3 + k, 3 + j] += weight * M[k, j]
        system[3 + k, 6] -= weight * u[k]
    system[0, 6] -= weight * (a[1] * u[2] - a[2] * u[1])
    system[1, 6] -= weight * (a[2] * u[0] - a[0] * u[2])
    system[2, 6] -= weight * (a[0] * u[1] - a[1] * u[0])


@njit(cache=True, nogil=True)
@no_type_check
def _in_lidar_frame(R: np.ndarray, system: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fill in the lower left and turn a step's axes from the map's to the lidar's."""
    turn = np.zeros((6, 6))
    turn[:3, :3], turn[3:, 3:] = R, R
    system[3:, :3] = system[:3, 3:6].T.copy()
    hessian, gradient = system[:, :6].copy(), system[:, 6].copy()
    return turn.T @ hessian @ turn, turn.T @ gradient

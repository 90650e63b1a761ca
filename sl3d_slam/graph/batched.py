"""The transforms of ``geometry.se3`` for many matrices at once; rotation first."""

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

Transforms = Float64[np.ndarray, "N 4 4"]
Matrices6 = Float64[np.ndarray, "N 6 6"]


def inverts(T_a_b: Transforms) -> Transforms:
    """Return ``T_b_a`` of each."""
    R_b_a = np.swapaxes(T_a_b[:, :3, :3], 1, 2)
    T_b_a = np.zeros_like(T_a_b)
    T_b_a[:, :3, :3] = R_b_a
    T_b_a[:, :3, 3] = -np.einsum("nij,nj->ni", R_b_a, T_a_b[:, :3, 3])
    T_b_a[:, 3, 3] = 1.0
    return T_b_a


def skews(v: Float64[np.ndarray, "N 3"]) -> Float64[np.ndarray, "N 3 3"]:
    """Return the matrix of the cross product with each vector."""
    S = np.zeros((len(v), 3, 3))
    S[:, 0, 1], S[:, 0, 2], S[:, 1, 2] = -v[:, 2], v[:, 1], -v[:, 0]
    return S - np.swapaxes(S, 1, 2)


def adjoints(T_a_b: Transforms) -> Matrices6:
    """Return Ad with ``T exp(xi) = exp(Ad xi) T`` of each."""
    R = T_a_b[:, :3, :3]
    result = np.zeros((len(T_a_b), 6, 6))
    result[:, :3, :3] = R
    result[:, 3:, 3:] = R
    result[:, 3:, :3] = skews(T_a_b[:, :3, 3]) @ R
    return result


def logs(T_a_b: Transforms) -> Float64[np.ndarray, "N 6"]:
    """Return the twist ``(omega, v)`` of each."""
    omega = Rotation.from_matrix(T_a_b[:, :3, :3]).as_rotvec()
    angle = np.linalg.norm(omega, axis=1)
    safe = np.maximum(angle, 1e-8)
    second = np.where(angle < 1e-8, 0.0, (1.0 - 0.5 * safe / np.tan(0.5 * safe)) / safe**2)
    W = skews(omega)
    V_inverse = np.eye(3) - 0.5 * W + second[:, None, None] * (W @ W)
    return np.hstack([omega, np.einsum("nij,nj->ni", V_inverse, T_a_b[:, :3, 3])])


def conjugates(A: Matrices6, P: Matrices6) -> Matrices6:
    """Return ``A P A^T`` of each pair."""
    return A @ P @ np.swapaxes(A, 1, 2)


def squared_norms(
    residuals: Float64[np.ndarray, "N 6"], covariances: Matrices6
) -> Float64[np.ndarray, "N"]:
    """Return ``r^T P^-1 r`` of each pair."""
    solved = np.linalg.solve(covariances, residuals[:, :, None])[:, :, 0]
    return np.einsum("ni,ni->n", residuals, solved)

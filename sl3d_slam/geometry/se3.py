"""Rigid transforms as 4 x 4 matrices: ``p_a = T_a_b @ p_b``.

Tangent vectors are in GTSAM's order, rotation first: ``xi = (omega, v)``, and act on the right,
``T_a_b' = T_a_b @ exp(xi)``, so that they live in frame b.
"""

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

Transform = Float64[np.ndarray, "4 4"]
Points = Float64[np.ndarray, "N 3"]


def make_transform(R_a_b: Float64[np.ndarray, "3 3"], t_a_b: Float64[np.ndarray, "3"]) -> Transform:
    """Join a rotation and a translation to one matrix."""
    T_a_b = np.eye(4)
    T_a_b[:3, :3] = R_a_b
    T_a_b[:3, 3] = t_a_b
    return T_a_b


def invert(T_a_b: Transform) -> Transform:
    """Return ``T_b_a``, exactly orthogonal where ``T_a_b`` is."""
    R_b_a = T_a_b[:3, :3].T
    return make_transform(R_b_a, -R_b_a @ T_a_b[:3, 3])


def transform_points(T_a_b: Transform, points_b: Points) -> Points:
    """Express points given in frame b in frame a: ``p_a = T_a_b @ p_b``."""
    return points_b @ T_a_b[:3, :3].T + T_a_b[:3, 3]


def rotation_angle_rad(T_a_b: Transform) -> float:
    """Return the angle of the rotation part, in [0, pi]."""
    return float(Rotation.from_matrix(T_a_b[:3, :3]).magnitude())


def distances_travelled_m(path: Points) -> Float64[np.ndarray, "N"]:
    """Return how far it is along a path to each of its points, 0 at the first."""
    steps_m = np.linalg.norm(np.diff(path, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps_m)])


def distance_m(T_a_b: Transform) -> float:
    """Return the length of the translation part."""
    return float(np.linalg.norm(T_a_b[:3, 3]))


def from_yaw(yaw_rad: float, t_a_b: Float64[np.ndarray, "3"]) -> Transform:
    """Turn about z by ``yaw_rad``, then shift."""
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    return make_transform(np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]), t_a_b)


def nearest_rotation(matrix: Float64[np.ndarray, "3 3"]) -> Float64[np.ndarray, "3 3"]:
    """Return the rotation (determinant +1) nearest to a matrix in the Frobenius norm."""
    U, _, Vt = np.linalg.svd(matrix)
    sign = np.sign(np.linalg.det(U @ Vt))
    return U @ np.diag([1.0, 1.0, sign]) @ Vt


def rotation_between(
    direction_b: Float64[np.ndarray, "3"], direction_a: Float64[np.ndarray, "3"]
) -> Float64[np.ndarray, "3 3"]:
    """Return the smallest rotation ``R_a_b`` that takes one unit vector to another."""
    axis = np.cross(direction_b, direction_a)
    sine, cosine = float(np.linalg.norm(axis)), float(direction_b @ direction_a)
    if sine < 1e-12:
        if cosine > 0:
            return np.eye(3)
        normal = np.cross(direction_b, np.eye(3)[np.argmin(np.abs(direction_b))])
        return Rotation.from_rotvec(np.pi * normal / np.linalg.norm(normal)).as_matrix()
    return Rotation.from_rotvec(np.arctan2(sine, cosine) * axis / sine).as_matrix()


def skew(v: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "3 3"]:
    """Return the matrix of the cross product: ``skew(v) @ w = v x w``."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def adjoint(T_a_b: Transform) -> Float64[np.ndarray, "6 6"]:
    """Return Ad with ``T_a_b exp(xi_b) = exp(Ad xi_b) T_a_b``, rotation first."""
    R, t = T_a_b[:3, :3], T_a_b[:3, 3]
    result = np.zeros((6, 6))
    result[:3, :3] = R
    result[3:, 3:] = R
    result[3:, :3] = skew(t) @ R
    return result


def exp(xi: Float64[np.ndarray, "6"]) -> Transform:
    """Return the transform of a twist ``(omega, v)``: the exponential map of SE(3)."""
    omega, v = xi[:3], xi[3:]
    angle = float(np.linalg.norm(omega))
    W = skew(omega)
    if angle < 1e-8:
        V = np.eye(3) + 0.5 * W
    else:
        V = (
            np.eye(3)
            + (1.0 - np.cos(angle)) / angle**2 * W
            + (angle - np.sin(angle)) / angle**3 * W @ W
        )
    return make_transform(Rotation.from_rotvec(omega).as_matrix(), V @ v)


def log(T_a_b: Transform) -> Float64[np.ndarray, "6"]:
    """Return the twist ``(omega, v)`` of a transform: the inverse of :func:`exp`."""
    omega = Rotation.from_matrix(T_a_b[:3, :3]).as_rotvec()
    angle = float(np.linalg.norm(omega))
    W = skew(omega)
    if angle < 1e-8:
        V_inverse = np.eye(3) - 0.5 * W
    else:
        half = 0.5 * angle
        V_inverse = np.eye(3) - 0.5 * W + (1.0 - half / np.tan(half)) / angle**2 * W @ W
    return np.concatenate([omega, V_inverse @ T_a_b[:3, 3]])


def interpolate(T_a_b: Transform, T_a_c: Transform, fraction: float) -> Transform:
    """Move from ``T_a_b`` (fraction 0) to ``T_a_c`` (fraction 1) along the screw between them."""
    return T_a_b @ exp(fraction * log(invert(T_a_b) @ T_a_c))

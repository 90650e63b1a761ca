"""Transforms from outside, checked and made exactly rigid: gtsam trusts what it is given.

A rotation that is off by 1e-6 (a text file, float32) grows over a chain of products until the
linear system is no longer positive definite.
"""

import numpy as np

from sl3d_slam.errors import GraphError
from sl3d_slam.geometry.se3 import Transform
from sl3d_slam.graph.batched import Transforms

EXACT = 1e-13  # rounding of a product of rotations; nothing to repair
MAX_ERROR = 1e-3  # of R^T R from the identity; more is not a rounded rotation


def rigid_transform(T_a_b: Transform, name: str) -> Transform:
    """Return the transform with the nearest rotation; ``name`` says whose it is in an error."""
    if _is_exact(T_a_b):
        return T_a_b.copy()
    return rigid_transforms(T_a_b[None], name)[0]


def rigid_transforms(T_a_b: Transforms, name: str) -> Transforms:
    """Return many transforms, each with its nearest rotation.

    Raises
    ------
    GraphError
        where one is not finite or not a rigid transform within rounding.
    """
    bad = np.flatnonzero(~np.isfinite(T_a_b).all(axis=(1, 2)))
    if len(bad):
        raise GraphError(f"{name}: transform {bad[0]} holds values that are not finite")
    R = T_a_b[:, :3, :3]
    error = np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).max(axis=(1, 2), initial=0.0)
    last_row_off = np.abs(T_a_b[:, 3] - [0.0, 0.0, 0.0, 1.0]).max(axis=1, initial=0.0)
    bad = np.flatnonzero((error > MAX_ERROR) | (last_row_off > 1e-9) | (np.linalg.det(R) <= 0))
    if len(bad):
        raise GraphError(f"{name}: transform {bad[0]} is not a rotation and a translation")
    U, _, Vt = np.linalg.svd(R)
    result = T_a_b.copy()
    result[:, :3, :3] = U @ Vt
    result[:, 3] = [0.0, 0.0, 0.0, 1.0]
    return result


def _is_exact(T_a_b: Transform) -> bool:
    R = T_a_b[:3, :3]
    difference = R.T @ R
    difference.flat[::4] -= 1.0
    exact = float(np.abs(difference).max()) < EXACT  # False for NaN
    return exact and np.array_equal(T_a_b[3], [0.0, 0.0, 0.0, 1.0]) and float(np.linalg.det(R)) > 0

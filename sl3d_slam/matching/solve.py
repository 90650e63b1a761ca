"""A pose from matched lines and a first guess, by the paper's point-to-line cost.

Source: SuperLine3D, Eq. 5 (point-to-line distances over all matches) and its rejection of matches
farther than 1 m; here each source line gives its two end points and robust weights.
"""

import numpy as np
from jaxtyping import Float64, Int64

from sl3d_slam.geometry.se3 import Transform, exp, nearest_rotation, transform_points
from sl3d_slam.geometry.segments import directions, midpoints, transform_segments
from sl3d_slam.types import LineSet

REJECT_M = 1.0
ROBUST_M = 0.2
LINE_SIGMA_M = 0.1
UP_SIGMA_RAD = np.radians(1.0)  # of two views; slopes that differ and leaning lines included
ITERATIONS = 12
FREE_SHARE = 1e-3
FILL_UNITS = np.repeat([0.05, 1.0], 3)  # a turn and a shift that move things 20 m away alike
FILL_SHARE = 1e-9

Up = Float64[np.ndarray, "3"]  # a unit vector


def refine_on_lines(
    source: LineSet,
    target: LineSet,
    matches: Int64[np.ndarray, "M 2"],
    T_target_source: Transform,
    ups: tuple[Up, Up] | None = None,
) -> tuple[Transform, Float64[np.ndarray, "6 6"]]:
    """Minimise robust point-to-line distances; directions that no line fixes stay as they are.

    Upright poles leave the height free; their lengths tell roll and pitch, if weakly: ``ups``, the
    way up in the source and in the target, hold those, within what slopes allow. A direction
    counts as free where a move along it (a turn by its lever: the points' mean range) shifts the
    lines by less than a thirtieth of what it does in the best-held direction.

    Returns
    -------
    The refined pose and its information (rotation first, at the source frame), in which a free
    direction is exactly zero.
    """
    points, origins, axes = _end_points_and_lines(source, target, matches)
    T, H = T_target_source, np.zeros((6, 6))
    units = _comparable_units(points)
    for _ in range(ITERATIONS):
        H, gradient = _normal_equations(T, points, origins, axes)
        held, pull = _pull_upright(T, ups)
        step = -_solve_where_fixed(H + held, gradient + pull, units)
        T = T @ exp(step)
        if np.linalg.norm(step) < 1e-6:
            break
    T[:3, :3] = nearest_rotation(T[:3, :3])
    return T, _drop_free_directions(H, units) / LINE_SIGMA_M**2


def line_information(
    source: LineSet,
    target: LineSet,
    matches: Int64[np.ndarray, "M 2"],
    T_target_source: Transform,
) -> Float64[np.ndarray, "6 6"]:
    """Return what matched lines say of a pose (rotation first, source frame); zero where free."""
    points, origins, axes = _end_points_and_lines(source, target, matches)
    H, _ = _normal_equations(T_target_source, points, origins, axes)
    return _drop_free_directions(H, _comparable_units(points)) / LINE_SIGMA_M**2


def fill_free(
    information: Float64[np.ndarray, "6 6"], other: Float64[np.ndarray, "6 6"]
) -> Float64[np.ndarray, "6 6"]:
    """Take from ``other`` what it says of the directions of which ``information`` says nothing."""
    values, vectors = np.linalg.eigh(information * np.outer(FILL_UNITS, FILL_UNITS))
    free = vectors[:, values <= FILL_SHARE * max(float(values[-1]), 1e-12)]
    across = free @ free.T / FILL_UNITS * FILL_UNITS[:, None]
    return information + across.T @ other @ across


def line_distances_m(
    source: LineSet,
    target: LineSet,
    matches: Int64[np.ndarray, "M 2"],
    T_target_source: Transform,
) -> Float64[np.ndarray, "M"]:
    """Return the mean distance of each source line's end points from its target line."""
    moved = transform_segments(T_target_source, source.endpoints[matches[:, 0]])
    offset = moved - midpoints(target.endpoints)[matches[:, 1], None]
    axes = directions(target.endpoints)[matches[:, 1], None]
    return np.linalg.norm(np.cross(offset, axes), axis=2).mean(axis=1)


def _end_points_and_lines(
    source: LineSet, target: LineSet, matches: Int64[np.ndarray, "M 2"]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the source's end points (2 M, 3) with a point and the axis of each one's line."""
    points = source.endpoints[matches[:, 0]].reshape(-1, 3)
    origins = np.repeat(midpoints(target.endpoints)[matches[:, 1]], 2, axis=0)
    axes = np.repeat(directions(target.endpoints)[matches[:, 1]], 2, axis=0)
    return points, origins, axes


def _normal_equations(
    T: Transform, points: np.ndarray, origins: np.ndarray, axes: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    offset = transform_points(T, points) - origins
    residual = offset - (offset * axes).sum(axis=1, keepdims=True) * axes
    length = np.linalg.norm(residual, axis=1)
    root = np.where(length < REJECT_M, 1.0 / (1.0 + (length / ROBUST_M) ** 2), 0.0)[:, None]
    turns = np.cross(np.eye(3), points[:, None]).swapaxes(1, 2)  # -skew(point), each
    moves = T[:3, :3] @ np.concatenate([turns, np.broadcast_to(np.eye(3), turns.shape)], axis=2)
    across = moves - axes[:, :, None] * (axes[:, None] @ moves)
    J = (root[:, :, None] * across).reshape(-1, 6)
    return J.T @ J, J.T @ (root * residual).ravel()


def _pull_upright(T: Transform, ups: tuple[Up, Up] | None) -> tuple[np.ndarray, np.ndarray]:
    """Return the normal equations of two ways up that should agree."""
    H, gradient = np.zeros((6, 6)), np.zeros(6)
    if ups is not None:
        weight = (LINE_SIGMA_M / UP_SIGMA_RAD) ** 2
        across = np.eye(3) - np.outer(ups[0], ups[0])
        H[:3, :3] = weight * across
        gradient[:3] = weight * across @ np.cross(T[:3, :3].T @ ups[1], ups[0])
    return H, gradient


def _comparable_units(points: np.ndarray) -> np.ndarray:
    """Return a step in each of the six directions that moves the points about equally far."""
    lever_m = max(1.0, float(np.sqrt((points**2).sum() / max(1, len(points)))))
    return np.repeat([1.0 / lever_m, 1.0], 3)


def _spectrum(H: np.ndarray, units: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return eigenvalues and eigenvectors of the directions that are fixed, in these units."""
    values, vectors = np.linalg.eigh(H * np.outer(units, units))
    fixed = values > FREE_SHARE * max(values[-1], 1e-12)
    return values[fixed], vectors[:, fixed]


def _solve_where_fixed(H: np.ndarray, gradient: np.ndarray, units: np.ndarray) -> np.ndarray:
    values, basis = _spectrum(H, units)
    return units * (basis @ ((basis.T @ (units * gradient)) / values))


def _drop_free_directions(H: np.ndarray, units: np.ndarray) -> np.ndarray:
    values, basis = _spectrum(H, units)
    return (basis * values) @ basis.T / np.outer(units, units)

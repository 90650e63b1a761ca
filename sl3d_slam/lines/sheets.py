"""Upright sheets (walls, fences) by region growing; compiled."""

from typing import no_type_check

import numpy as np
from numba import njit

from sl3d_slam.lines.structure import CELL_M

OFF_PLANE_M = 0.12
MIN_NORMAL_COSINE = 0.94
MAX_STEP_UP_M = 1.5
MIN_FITTED = 15


@njit(cache=True, nogil=True)
@no_type_check
def grow_sheets(
    points: np.ndarray,
    normals: np.ndarray,
    seeds: np.ndarray,
    index: tuple[np.ndarray, np.ndarray],
    half_width_m: float,
    radius_m: float,
) -> np.ndarray:
    """Label upright sheets: neighbours within ``radius_m`` that stay on one vertical plane.

    ``seeds`` are indices of the points that may belong to a sheet, best first; ``normals`` are
    horizontal (N, 2); ``index`` is the horizontal cell index of the points. Returns (N,) labels
    from 0, -1 for no sheet.
    """
    label = np.full(len(points), -2, np.int64)
    label[seeds] = -1
    queue = np.empty(len(points), np.int64)
    count = 0
    for seed in seeds:
        if label[seed] != -1:
            continue
        label[seed], queue[0] = count, seed
        head, tail = 0, 1
        moments = np.zeros(6)
        plane = np.array([normals[seed, 0], normals[seed, 1], points[seed, 0], points[seed, 1]])
        origin = points[seed].copy()
        while head < tail:
            i = queue[head]
            head += 1
            _update_plane(plane, moments, origin, points[i])
            tail = _visit(
                (points, normals, label, queue),
                index,
                plane,
                (i, count, tail),
                (half_width_m, radius_m),
            )
        count += 1
    return np.maximum(label, -1)


@njit(cache=True)
@no_type_check
def _update_plane(
    plane: np.ndarray, moments: np.ndarray, origin: np.ndarray, point: np.ndarray
) -> None:
    """Take one more point into the running plane: normal x, y and mean x, y."""
    dx, dy = point[0] - origin[0], point[1] - origin[1]
    moments += np.array([1.0, dx, dy, dx * dx, dy * dy, dx * dy])
    n = moments[0]
    mx, my = moments[1] / n, moments[2] / n
    plane[2], plane[3] = origin[0] + mx, origin[1] + my
    if n >= MIN_FITTED:
        xx, yy, xy = moments[3] / n - mx * mx, moments[4] / n - my * my, moments[5] / n - mx * my
        angle = 0.5 * np.arctan2(2 * xy, xx - yy) + 0.5 * np.pi
        plane[0], plane[1] = np.cos(angle), np.sin(angle)


@njit(cache=True)
@no_type_check
def _visit(
    arrays: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
    index: tuple[np.ndarray, np.ndarray],
    plane: np.ndarray,
    state: tuple[int, int, int],
    lengths: tuple[float, float],
) -> int:
    """Queue the unlabelled neighbours of one point that fit the plane; return the queue's end."""
    points, normals, label, queue = arrays
    order, start = index
    i, count, tail = state
    half_width_m, radius_m = lengths
    size, reach = int(np.ceil(2 * half_width_m / CELL_M)), int(np.ceil(radius_m / CELL_M))
    x, y, z = points[i, 0], points[i, 1], points[i, 2]
    cx, cy = int((x + half_width_m) / CELL_M), int((y + half_width_m) / CELL_M)
    low, last = max(cy - reach, 0), min(cy + reach, size - 1)
    for a in range(max(cx - reach, 0), min(cx + reach + 1, size)):
        for position in range(start[a * size + low], start[a * size + last + 1]):
            j = order[position]
            if label[j] != -1 or abs(points[j, 2] - z) > MAX_STEP_UP_M:
                continue
            squared = (points[j, 0] - x) ** 2 + (points[j, 1] - y) ** 2
            offset = plane[0] * (points[j, 0] - plane[2]) + plane[1] * (points[j, 1] - plane[3])
            cosine = plane[0] * normals[j, 0] + plane[1] * normals[j, 1]
            if (
                squared < radius_m * radius_m
                and abs(offset) < OFF_PLANE_M
                and abs(cosine) > MIN_NORMAL_COSINE
            ):
                label[j], queue[tail] = count, j
                tail += 1
    return tail

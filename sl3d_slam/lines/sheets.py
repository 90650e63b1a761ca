"""Upright sheets (walls, fences) by region growing, and the view past an edge; compiled."""

import numpy as np
from numba import njit

from sl3d_slam.lines.structure import CELL_M

AZIMUTH_BINS = 1440
ELEVATION_BINS = 90


@njit(cache=True)
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
    order, start = index
    size = int(np.ceil(2 * half_width_m / CELL_M))
    reach = int(np.ceil(radius_m / CELL_M))
    eligible = np.zeros(len(points), np.bool_)
    for seed in seeds:
        eligible[seed] = True
    label = np.full(len(points), -1, np.int64)
    queue = np.empty(len(points), np.int64)
    count = 0
    for seed in seeds:
        if label[seed] >= 0:
            continue
        label[seed] = count
        queue[0], head, tail = seed, 0, 1
        nx, ny = normals[seed, 0], normals[seed, 1]
        x0, y0 = points[seed, 0], points[seed, 1]
        sx = sy = sxx = syy = sxy = 0.0
        while head < tail:
            i = queue[head]
            head += 1
            dx, dy = points[i, 0] - x0, points[i, 1] - y0
            sx += dx
            sy += dy
            sxx += dx * dx
            syy += dy * dy
            sxy += dx * dy
            mx, my = sx / head, sy / head
            if head >= 15:
                a, b, c = sxx / head - mx * mx, sxy / head - mx * my, syy / head - my * my
                angle = 0.5 * np.arctan2(2 * b, a - c) + 0.5 * np.pi
                nx, ny = np.cos(angle), np.sin(angle)
            cx = int((points[i, 0] + half_width_m) / CELL_M)
            cy = int((points[i, 1] + half_width_m) / CELL_M)
            for ix in range(max(cx - reach, 0), min(cx + reach + 1, size)):
                low, last = max(cy - reach, 0), min(cy + reach, size - 1)
                for position in range(start[ix * size + low], start[ix * size + last + 1]):
                    j = order[position]
                    if label[j] >= 0 or not eligible[j]:
                        continue
                    ex, ey = points[j, 0] - points[i, 0], points[j, 1] - points[i, 1]
                    if ex * ex + ey * ey > radius_m * radius_m:
                        continue
                    if abs(points[j, 2] - points[i, 2]) > 1.5:
                        continue
                    offset = nx * (points[j, 0] - x0 - mx) + ny * (points[j, 1] - y0 - my)
                    if abs(offset) > 0.12:
                        continue
                    if abs(nx * normals[j, 0] + ny * normals[j, 1]) < 0.94:
                        continue
                    label[j] = count
                    queue[tail] = j
                    tail += 1
        count += 1
    return label


@njit(cache=True)
def nearest_ranges(points: np.ndarray) -> np.ndarray:
    """Return the nearest horizontal range per azimuth (0.25 deg) and elevation (1 deg) bin."""
    image = np.full((AZIMUTH_BINS, ELEVATION_BINS), np.inf)
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        planar = np.sqrt(x * x + y * y)
        azimuth = int((np.arctan2(y, x) + np.pi) / (2 * np.pi) * AZIMUTH_BINS) % AZIMUTH_BINS
        elevation = int(np.floor(np.degrees(np.arctan2(z, planar)))) + ELEVATION_BINS // 2
        elevation = min(max(elevation, 0), ELEVATION_BINS - 1)
        image[azimuth, elevation] = min(image[azimuth, elevation], planar)
    return image


@njit(cache=True)
def hidden_share(
    image: np.ndarray, points: np.ndarray, azimuth_from: float, azimuth_to: float, margin_m: float
) -> float:
    """Return the share of an edge's points beside which something nearer is seen.

    The view beside the edge is the azimuth interval given (radians, from the edge outwards); a bin
    at the elevation of a point is nearer when its range is less by more than ``margin_m``.
    """
    scale = AZIMUTH_BINS / (2 * np.pi)
    sign = 1 if azimuth_to > azimuth_from else -1
    first = int(np.floor((azimuth_from + np.pi) * scale))
    steps = max(int(np.ceil(abs(azimuth_to - azimuth_from) * scale)), 2)
    hidden = 0
    for i in range(len(points)):
        planar = np.sqrt(points[i, 0] ** 2 + points[i, 1] ** 2)
        elevation = (
            int(np.floor(np.degrees(np.arctan2(points[i, 2], planar)))) + ELEVATION_BINS // 2
        )
        elevation = min(max(elevation, 0), ELEVATION_BINS - 1)
        for step in range(steps):
            if image[(first + sign * step) % AZIMUTH_BINS, elevation] < planar - margin_m:
                hidden += 1
                break
    return hidden / max(len(points), 1)

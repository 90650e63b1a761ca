# ruff: noqa: ANN001, ANN201 - compiled code; numba infers the types
"""One sweep by ray casting, with labels and true lines: compiled."""

from typing import NamedTuple, no_type_check

import numpy as np
from numba import njit

from sl3d_slam.simulation.intersect import (
    GLASS,
    INSIDE,
    LOST,
    chance,
    gaussian,
    mix,
    patch_coordinates,
)
from sl3d_slam.simulation.march import ground_at, march_ground
from sl3d_slam.simulation.traverse import nearest

EDGE_M = 0.13


class Beams(NamedTuple):
    """The rays of a sweep: directions (R, 3) in the sensor frame, and the sensor's numbers.

    ``numbers``: least range, largest range, range noise, share lost, detection threshold.
    """

    directions: np.ndarray
    numbers: np.ndarray


@njit(cache=True, error_model="numpy")
@no_type_check
def facing(scene, item, o, d, t):
    """Return the cosine of the angle at which a ray meets a primitive."""
    rows, kind = scene.parameters, scene.kinds[item]
    if scene.materials[item, 2] > 0.0:
        return 0.6
    x, y, z = (
        o[0] + t * d[0] - rows[item, 0],
        o[1] + t * d[1] - rows[item, 1],
        o[2] + t * d[2] - rows[item, 2],
    )
    if kind == 2:
        return abs(d[0] * rows[item, 9] + d[1] * rows[item, 10] + d[2] * rows[item, 11])
    if kind == 0:
        a, b = (
            (rows[item, 3] * x + rows[item, 4] * y) / rows[item, 5],
            (rows[item, 3] * y - rows[item, 4] * x) / rows[item, 6],
        )
        if abs(z / rows[item, 7]) > max(abs(a), abs(b)):
            return abs(d[2])
        if abs(a) > abs(b):
            return abs(rows[item, 3] * d[0] + rows[item, 4] * d[1])
        return abs(rows[item, 3] * d[1] - rows[item, 4] * d[0])
    if kind == 1:
        s = x * rows[item, 3] + y * rows[item, 4] + z * rows[item, 5]
        nx, ny, nz = x - s * rows[item, 3], y - s * rows[item, 4], z - s * rows[item, 5]
    else:
        nx, ny, nz = x / rows[item, 3] ** 2, y / rows[item, 4] ** 2, z / rows[item, 5] ** 2
    dot = nx * d[0] + ny * d[1] + nz * d[2]
    return abs(dot) / max(np.sqrt(nx * nx + ny * ny + nz * nz), 1e-9)


@njit(cache=True, error_model="numpy")
@no_type_check
def line_of(scene, item, o, d, t):
    """Return the id of the true line that a point of a primitive belongs to, or -1."""
    edges = scene.edges
    if scene.kinds[item] == 1:
        return edges[item, 0]
    if scene.kinds[item] != 2:
        return -1
    rows = scene.parameters
    u, v = patch_coordinates(rows, item, o, d, t)
    lean = 0.5 * rows[item, 14] * rows[item, 12] / rows[item, 13]
    shrink = 1.0 / np.sqrt(1.0 + lean * lean)
    gaps = (
        (u - lean * v) * shrink,
        (rows[item, 12] - lean * v - u) * shrink,
        v,
        rows[item, 13] - v,
    )
    best, line = EDGE_M, np.int64(-1)
    for k in range(4):
        if edges[item, k] >= 0 and gaps[k] < best:
            best, line = gaps[k], edges[item, k]
    return line


@njit(cache=True, error_model="numpy")
@no_type_check
def ground_cover(scene, o, d, t, key):
    """Return class, reflectivity and roughness of the ground where a ray meets it."""
    x, y = o[0] + t * d[0], o[1] + t * d[1]
    _, distance, pavement = ground_at(scene.ground, scene.layout, x, y)
    if distance < 0.0:
        marking = abs(distance + 0.35) < 0.07
        return 40, (0.55 if marking else 0.22), 0.004
    if distance < pavement:
        return 48, 0.34, 0.005
    return 72, 0.45, 0.03 + 0.08 * chance(key, 3)


@njit(cache=True, inline="always", error_model="numpy")
@no_type_check
def look_up(scene, o, d, key, high):
    """Return what a ray meets: t (inf: nothing), reflectivity, cosine, roughness, label, line."""
    t_ground = march_ground(scene.ground, scene.layout, o, d, high)
    t, item, what = nearest(scene, o, d, key, min(t_ground, high))
    if item < 0:
        if t_ground >= high:
            return np.inf, 0.0, 0.0, 0.0, 0, np.int64(-1)
        label, shine, rough = ground_cover(scene, o, d, t, key)
        return t, shine, abs(d[2]), rough, label, np.int64(-1)
    if what == LOST:
        return np.inf, 0.0, 0.0, 0.0, 0, np.int64(-1)
    label, shine = int(scene.materials[item, 0]), scene.materials[item, 1]
    cosine = facing(scene, item, o, d, t)
    if what in (GLASS, INSIDE):
        return t, 0.4 * shine, cosine, 0.0, label, np.int64(-1)
    return t, shine, cosine, 0.0, label, line_of(scene, item, o, d, t)


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def cast(scene, beams, T, seed, start, stop, out):  # noqa: PLR0913
    """Cast the rays from ``start`` to before ``stop``, whose rows of ``out`` (R, 4) it fills.

    A row gets range (nan: no return), intensity, label and line id; other rows stay as they are.
    """
    low, high, sigma, lost, threshold = beams.numbers
    root = mix(seed)
    for ray in range(start, stop):
        key = mix(root + np.uint64(ray))
        a, b, c = beams.directions[ray, 0], beams.directions[ray, 1], beams.directions[ray, 2]
        d = (
            T[0, 0] * a + T[0, 1] * b + T[0, 2] * c,
            T[1, 0] * a + T[1, 1] * b + T[1, 2] * c,
            T[2, 0] * a + T[2, 1] * b + T[2, 2] * c,
        )
        o = (T[0, 3], T[1, 3], T[2, 3])
        t, shine, cosine, rough, label, line = look_up(scene, o, d, key, high)
        echo = shine * cosine / (t * t) * np.exp(0.8 * gaussian(key, 5))
        t += sigma * gaussian(key, 1) + rough * (chance(key, 7) - 0.5)
        seen = echo >= threshold and low <= t <= high and chance(key, 4) >= lost
        level = shine * (0.5 + 0.5 * cosine) * (1.0 + 0.25 * gaussian(key, 9))
        out[ray, 0] = t if seen else np.nan
        out[ray, 1] = min(max(level, 0.0), 0.99)
        out[ray, 2] = label
        out[ray, 3] = line

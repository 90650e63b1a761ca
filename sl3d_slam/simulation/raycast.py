# ruff: noqa: ANN001, ANN201 - compiled code; numba infers the types
"""One sweep by ray casting: ground by marching, everything else through a grid of cells."""

from typing import NamedTuple, no_type_check

import numpy as np
from numba import njit, prange

from sl3d_slam.simulation.intersect import (
    GLASS,
    INSIDE,
    LOST,
    chance,
    gaussian,
    hit_box,
    hit_cylinder,
    hit_ellipsoid,
    hit_patch,
    mix,
    patch_coordinates,
)

EDGE_M = 0.13
KERB_RAMP_M = 0.04
MAX_SLOPE = 0.15


class SceneArrays(NamedTuple):
    """All that a ray can meet, as plain arrays (town frame, metres).

    ``ground[j, i]``: height, signed distance to the road (negative on it), kerb height, pavement
    width; ``layout``: low x, low y, ground spacing, cell size. ``starts``/``items`` list the
    primitives of each cell, ``heads``/``nodes`` (item, next) those that move.
    """

    ground: np.ndarray
    layout: np.ndarray
    kinds: np.ndarray
    parameters: np.ndarray
    materials: np.ndarray
    edges: np.ndarray
    starts: np.ndarray
    items: np.ndarray
    tops: np.ndarray
    heads: np.ndarray
    nodes: np.ndarray


class Beams(NamedTuple):
    """The rays of a sweep: directions (R, 3) in the sensor frame, and the sensor's numbers.

    ``numbers``: least range, largest range, range noise, share lost, detection threshold.
    """

    directions: np.ndarray
    numbers: np.ndarray


@njit(cache=True)
@no_type_check
def ground_at(ground, layout, x, y):
    """Return height (kerb included), signed distance to the road and pavement width."""
    fx = min(max((x - layout[0]) / layout[2], 0.0), ground.shape[1] - 1.001)
    fy = min(max((y - layout[1]) / layout[2], 0.0), ground.shape[0] - 1.001)
    i, j = int(fx), int(fy)
    a, b = fx - i, fy - j
    w00, w01, w10, w11 = (1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b
    q00, q01, q10, q11 = ground[j, i], ground[j, i + 1], ground[j + 1, i], ground[j + 1, i + 1]
    height = w00 * q00[0] + w01 * q01[0] + w10 * q10[0] + w11 * q11[0]
    distance = w00 * q00[1] + w01 * q01[1] + w10 * q10[1] + w11 * q11[1]
    kerb = w00 * q00[2] + w01 * q01[2] + w10 * q10[2] + w11 * q11[2]
    raised = min(max(distance / KERB_RAMP_M, 0.0), 1.0)
    return height + kerb * raised, distance, q00[3]


@njit(cache=True)
@no_type_check
def march_ground(scene, o, d, t_max):
    """Return where a ray meets the ground; slopes are at most MAX_SLOPE, kerbs excepted."""
    level = np.hypot(d[0], d[1])
    closing = MAX_SLOPE * level - d[2]
    if closing <= 0.0:
        return np.inf
    t_above, t = 0.0, 0.0
    while t < t_max:
        height, _, _ = ground_at(scene.ground, scene.layout, o[0] + t * d[0], o[1] + t * d[1])
        gap = o[2] + t * d[2] - height
        if gap <= 0.0:
            break
        t_above = t
        t += max(0.25, gap / closing)
    if t >= t_max:
        return np.inf
    t_below = t
    for _ in range(14):
        t = 0.5 * (t_above + t_below)
        height, _, _ = ground_at(scene.ground, scene.layout, o[0] + t * d[0], o[1] + t * d[1])
        if o[2] + t * d[2] > height:
            t_above = t
        else:
            t_below = t
    return t_below


@njit(cache=True)
@no_type_check
def meet(scene, item, o, d, key):
    """Return where a ray meets one primitive, and what it met there."""
    p, density = scene.parameters[item], scene.materials[item, 2]
    kind, ray = scene.kinds[item], (key, 16 * (item + 2))
    if kind == 2:
        return hit_patch(p, o, d, density, ray)
    if kind == 0:
        return hit_box(p, o, d, density, ray), 0
    if kind == 1:
        return hit_cylinder(p, o, d), 0
    return hit_ellipsoid(p, o, d, density, ray), 0


@njit(cache=True)
@no_type_check
def nearest(scene, o, d, key, t_max):
    """Return the first primitive along a ray before t_max: t, its index (-1 none), what."""
    best, which, what = t_max, -1, 0
    size, width, depth = scene.layout[3], scene.heads.shape[1], scene.heads.shape[0]
    i, j = int((o[0] - scene.layout[0]) / size), int((o[1] - scene.layout[1]) / size)
    step_i, step_j = (1 if d[0] > 0 else -1), (1 if d[1] > 0 else -1)
    delta_i = size / abs(d[0]) if d[0] != 0.0 else np.inf
    delta_j = size / abs(d[1]) if d[1] != 0.0 else np.inf
    edge_i = (i + (d[0] > 0)) * size + scene.layout[0]
    edge_j = (j + (d[1] > 0)) * size + scene.layout[1]
    next_i = (edge_i - o[0]) / d[0] if d[0] != 0.0 else np.inf
    next_j = (edge_j - o[1]) / d[1] if d[1] != 0.0 else np.inf
    t_in = 0.0
    while 0 <= i < width and 0 <= j < depth and t_in < best:
        t_out = min(next_i, next_j)
        cell = j * width + i
        if o[2] + d[2] * (t_in if d[2] > 0 else min(t_out, best)) < scene.tops[cell]:
            for k in range(scene.starts[cell], scene.starts[cell + 1]):
                t, met = meet(scene, scene.items[k], o, d, key)
                if t < best:
                    best, which, what = t, scene.items[k], met
        node = scene.heads[j, i]
        while node >= 0:
            t, met = meet(scene, scene.nodes[node, 0], o, d, key)
            if t < best:
                best, which, what = t, scene.nodes[node, 0], met
            node = scene.nodes[node, 1]
        t_in = t_out
        if next_i < next_j:
            i += step_i
            next_i += delta_i
        else:
            j += step_j
            next_j += delta_j
    return best, which, what


@njit(cache=True)
@no_type_check
def facing(scene, item, o, d, t):
    """Return the cosine of the angle at which a ray meets a primitive."""
    p, kind = scene.parameters[item], scene.kinds[item]
    if scene.materials[item, 2] > 0.0:
        return 0.6
    x, y, z = o[0] + t * d[0] - p[0], o[1] + t * d[1] - p[1], o[2] + t * d[2] - p[2]
    if kind == 2:
        return abs(d[0] * p[9] + d[1] * p[10] + d[2] * p[11])
    if kind == 0:
        a, b = (p[3] * x + p[4] * y) / p[5], (p[3] * y - p[4] * x) / p[6]
        if abs(z / p[7]) > max(abs(a), abs(b)):
            return abs(d[2])
        if abs(a) > abs(b):
            return abs(p[3] * d[0] + p[4] * d[1])
        return abs(p[3] * d[1] - p[4] * d[0])
    if kind == 1:
        s = x * p[3] + y * p[4] + z * p[5]
        nx, ny, nz = x - s * p[3], y - s * p[4], z - s * p[5]
    else:
        nx, ny, nz = x / p[3] ** 2, y / p[4] ** 2, z / p[5] ** 2
    dot = nx * d[0] + ny * d[1] + nz * d[2]
    return abs(dot) / max(np.sqrt(nx * nx + ny * ny + nz * nz), 1e-9)


@njit(cache=True)
@no_type_check
def line_of(scene, item, o, d, t):
    """Return the id of the true line that a point of a primitive belongs to, or -1."""
    edges = scene.edges[item]
    if scene.kinds[item] == 1:
        return edges[0]
    if scene.kinds[item] != 2:
        return -1
    p = scene.parameters[item]
    u, v = patch_coordinates(p, o, d, t)
    lean = 0.5 * p[14] * p[12] / p[13]
    shrink = 1.0 / np.sqrt(1.0 + lean * lean)
    gaps = ((u - lean * v) * shrink, (p[12] - lean * v - u) * shrink, v, p[13] - v)
    best, line = EDGE_M, np.int64(-1)
    for k in range(4):
        if edges[k] >= 0 and gaps[k] < best:
            best, line = gaps[k], edges[k]
    return line


@njit(cache=True)
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


@njit(cache=True)
@no_type_check
def look_up(scene, o, d, key, high):
    """Return what a ray meets: t (inf: nothing), reflectivity, cosine, roughness, label, line."""
    t_ground = march_ground(scene, o, d, high)
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


@njit(cache=True, parallel=True)
@no_type_check
def cast(scene, beams, T, seed, out):
    """Cast every ray; ``out`` (R, 4) gets range (nan: no return), intensity, label, line id."""
    low, high, sigma, lost, threshold = beams.numbers
    root = mix(seed)
    for ray in prange(beams.directions.shape[0]):
        key = mix(root + np.uint64(ray))
        b = beams.directions[ray]
        d = (
            T[0, 0] * b[0] + T[0, 1] * b[1] + T[0, 2] * b[2],
            T[1, 0] * b[0] + T[1, 1] * b[1] + T[1, 2] * b[2],
            T[2, 0] * b[0] + T[2, 1] * b[1] + T[2, 2] * b[2],
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

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


class SceneArrays(NamedTuple):
    """All that a ray can meet, as plain arrays (town frame, metres).

    ``ground[j, i]``: height, signed distance to the road (negative on it), kerb height, pavement
    width; ``layout``: low x, low y, ground spacing, cell size, steepest slope. ``starts``/``items``
    list the primitives of each cell, ``heads``/``nodes`` (item, next) those that move.
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


@njit(cache=True, error_model="numpy")
@no_type_check
def ground_at(ground, layout, x, y):
    """Return height (kerb included), signed distance to the road and pavement width."""
    fx = min(max((x - layout[0]) / layout[2], 0.0), ground.shape[1] - 1.001)
    fy = min(max((y - layout[1]) / layout[2], 0.0), ground.shape[0] - 1.001)
    i, j = int(fx), int(fy)
    a, b = fx - i, fy - j
    w00, w01, w10, w11 = (1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b
    height = w00 * ground[j, i, 0] + w01 * ground[j, i + 1, 0]
    height += w10 * ground[j + 1, i, 0] + w11 * ground[j + 1, i + 1, 0]
    distance = w00 * ground[j, i, 1] + w01 * ground[j, i + 1, 1]
    distance += w10 * ground[j + 1, i, 1] + w11 * ground[j + 1, i + 1, 1]
    kerb = w00 * ground[j, i, 2] + w01 * ground[j, i + 1, 2]
    kerb += w10 * ground[j + 1, i, 2] + w11 * ground[j + 1, i + 1, 2]
    raised = min(max(distance / KERB_RAMP_M, 0.0), 1.0)
    return height + kerb * raised, distance, ground[j, i, 3]


@njit(cache=True, error_model="numpy")
@no_type_check
def gap_at(ground, layout, o, d, t):
    """Return how far a point of a ray is above the ground."""
    x, y = o[0] + t * d[0], o[1] + t * d[1]
    return o[2] + t * d[2] - ground_at(ground, layout, x, y)[0]


@njit(cache=True, error_model="numpy")
@no_type_check
def march_ground(ground, layout, o, d, t_max):
    """Return where a ray meets the ground: safe steps while above, then regula falsi."""
    closing = layout[4] * np.hypot(d[0], d[1]) - d[2]
    if closing <= 0.0:
        return np.inf
    t_above, t = 0.0, 0.0
    above = below = gap_at(ground, layout, o, d, 0.0)
    while below > 0.0:
        t_above, above = t, below
        t += max(0.25, below / closing)
        if t >= t_max:
            return np.inf
        below = gap_at(ground, layout, o, d, t)
    t_below = t
    for _ in range(12):
        if above < 1e-3 or below > -1e-3:
            break
        t = t_above + (t_below - t_above) * above / (above - below)
        gap = gap_at(ground, layout, o, d, t)
        if gap > 0.0:
            t_above, above, below = t, gap, 0.5 * below
        else:
            t_below, below, above = t, gap, 0.5 * above
    return t_below if below > -above else t_above


@njit(cache=True, inline="always", error_model="numpy")
@no_type_check
def meet(scene, item, o, d, key):
    """Return where a ray meets one primitive, and what it met there."""
    rows, density = scene.parameters, scene.materials[item, 2]
    kind, ray = scene.kinds[item], (key, 16 * (item + 2))
    if kind == 2:
        return hit_patch(rows, item, o, d, density, ray)
    if kind == 0:
        return hit_box(rows, item, o, d, density, ray), 0
    if kind == 1:
        return hit_cylinder(rows, item, o, d), 0
    return hit_ellipsoid(rows, item, o, d, density, ray), 0


@njit(cache=True, error_model="numpy")
@no_type_check
def axis_steps(position, direction, size):
    """Return cell, step, t between two borders and t of the first border along one axis."""
    cell = int(position / size)
    if direction == 0.0:
        return cell, 1, np.inf, np.inf
    border = (cell + (1 if direction > 0.0 else 0)) * size
    step = 1 if direction > 0.0 else -1
    return cell, step, size / abs(direction), (border - position) / direction


@njit(cache=True, error_model="numpy")
@no_type_check
def nearest(scene, o, d, key, t_max):
    """Return the first primitive along a ray before t_max: t, its index (-1 none), what."""
    best, which, what = t_max, -1, 0
    size, width, depth = scene.layout[3], scene.heads.shape[1], scene.heads.shape[0]
    i, step_i, delta_i, next_i = axis_steps(o[0] - scene.layout[0], d[0], size)
    j, step_j, delta_j, next_j = axis_steps(o[1] - scene.layout[1], d[1], size)
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


@njit(cache=True, parallel=True, error_model="numpy")
@no_type_check
def cast(scene, beams, T, seed, out):
    """Cast every ray; ``out`` (R, 4) gets range (nan: no return), intensity, label, line id."""
    low, high, sigma, lost, threshold = beams.numbers
    root = mix(seed)
    for ray in prange(beams.directions.shape[0]):
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

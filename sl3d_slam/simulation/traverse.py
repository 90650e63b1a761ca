# ruff: noqa: ANN001, ANN201 - compiled code; numba infers the types
"""The first primitive along a ray, found through a grid of cells: compiled."""

from typing import NamedTuple, no_type_check

import numpy as np
from numba import njit

from sl3d_slam.simulation.intersect import hit_box, hit_cylinder, hit_ellipsoid, hit_patch


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

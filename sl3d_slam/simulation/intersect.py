# ruff: noqa: ANN001, ANN201 - compiled code; numba infers the types
"""Where a ray meets one primitive: compiled, one function a shape.

A ray is ``o + t * d`` with unit ``d``; row ``i`` of ``rows`` describes the primitive. Each function
returns ``t``, or infinity for a miss. Small arrays are passed, not whole scenes: copying those at
each call took most of the time.
Chance (foliage, fences, glass) is a hash of the ray and the primitive, never shared state, so the
answer does not depend on the number of threads.
"""

from typing import no_type_check

import numpy as np
from numba import njit

SOLID, GLASS, LOST, INSIDE = 0, 1, 2, 3


@njit(cache=True, inline="always", error_model="numpy")
@no_type_check
def mix(x):
    """Scramble 64 bits (the finaliser of splitmix64, Steele et al. 2014)."""
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))


@njit(cache=True, error_model="numpy")
@no_type_check
def chance(key, salt):
    """Return a number in (0, 1) that depends on the key of the ray and a salt only."""
    bits = mix(key + np.uint64(salt) * np.uint64(0x9E3779B97F4A7C15))
    return (np.float64(bits >> np.uint64(11)) + 0.5) * (1.0 / 9007199254740992.0)


@njit(cache=True, error_model="numpy")
@no_type_check
def gaussian(key, salt):
    """Return a standard normal number (Box-Muller)."""
    radius = np.sqrt(-2.0 * np.log(chance(key, salt)))
    return radius * np.cos(2.0 * np.pi * chance(key, salt + 1))


@njit(cache=True, error_model="numpy")
@no_type_check
def enter(t_in, t_out, density, key, salt):
    """Return where a ray stops that is within something from t_in to t_out."""
    if t_out <= t_in or t_out <= 0.0:
        return np.inf
    if density <= 0.0:
        return t_in if t_in > 0.0 else np.inf
    t = max(t_in, 0.0) - np.log(chance(key, salt)) / density
    return t if t < t_out else np.inf


@njit(cache=True, error_model="numpy")
@no_type_check
def slab(position, direction, half):
    """Return entry and exit of the slab |x| <= half along one axis."""
    if abs(direction) < 1e-12:
        return (-np.inf, np.inf) if abs(position) <= half else (np.inf, -np.inf)
    first, second = (-half - position) / direction, (half - position) / direction
    return (first, second) if first < second else (second, first)


@njit(cache=True, error_model="numpy")
@no_type_check
def hit_box(rows, i, o, d, density, ray):
    """Meet a box that is turned about z."""
    x, y = o[0] - rows[i, 0], o[1] - rows[i, 1]
    a0, a1 = slab(
        rows[i, 3] * x + rows[i, 4] * y, rows[i, 3] * d[0] + rows[i, 4] * d[1], rows[i, 5]
    )
    b0, b1 = slab(
        rows[i, 3] * y - rows[i, 4] * x, rows[i, 3] * d[1] - rows[i, 4] * d[0], rows[i, 6]
    )
    if max(a0, b0) > min(a1, b1):
        return np.inf
    c0, c1 = slab(o[2] - rows[i, 2], d[2], rows[i, 7])
    return enter(max(a0, b0, c0), min(a1, b1, c1), density, ray[0], ray[1])


@njit(cache=True, error_model="numpy")
@no_type_check
def hit_cylinder(rows, i, o, d):
    """Meet the mantle of a cylinder from outside."""
    x, y, z = o[0] - rows[i, 0], o[1] - rows[i, 1], o[2] - rows[i, 2]
    along_o = x * rows[i, 3] + y * rows[i, 4] + z * rows[i, 5]
    along_d = d[0] * rows[i, 3] + d[1] * rows[i, 4] + d[2] * rows[i, 5]
    ex, ey, ez = (
        d[0] - along_d * rows[i, 3],
        d[1] - along_d * rows[i, 4],
        d[2] - along_d * rows[i, 5],
    )
    fx, fy, fz = x - along_o * rows[i, 3], y - along_o * rows[i, 4], z - along_o * rows[i, 5]
    a = ex * ex + ey * ey + ez * ez
    b = ex * fx + ey * fy + ez * fz
    c = fx * fx + fy * fy + fz * fz - rows[i, 7] * rows[i, 7]
    root = b * b - a * c
    if root < 0.0 or a < 1e-14:
        return np.inf
    t = (-b - np.sqrt(root)) / a
    height = along_o + t * along_d
    return t if t > 0.0 and 0.0 <= height <= rows[i, 6] else np.inf


@njit(cache=True, error_model="numpy")
@no_type_check
def hit_ellipsoid(rows, i, o, d, density, ray):
    """Meet an ellipsoid with axes along x, y, z."""
    x, y, z = (
        (o[0] - rows[i, 0]) / rows[i, 3],
        (o[1] - rows[i, 1]) / rows[i, 4],
        (o[2] - rows[i, 2]) / rows[i, 5],
    )
    u, v, w = d[0] / rows[i, 3], d[1] / rows[i, 4], d[2] / rows[i, 5]
    a, b = u * u + v * v + w * w, x * u + y * v + z * w
    root = b * b - a * (x * x + y * y + z * z - 1.0)
    if root <= 0.0:
        return np.inf
    root = np.sqrt(root)
    return enter((-b - root) / a, (-b + root) / a, density, ray[0], ray[1])


@njit(cache=True, error_model="numpy")
@no_type_check
def patch_coordinates(rows, i, o, d, t):
    """Return u and v of a point of the ray in the plane of a patch."""
    x, y, z = (
        o[0] + t * d[0] - rows[i, 0],
        o[1] + t * d[1] - rows[i, 1],
        o[2] + t * d[2] - rows[i, 2],
    )
    return x * rows[i, 3] + y * rows[i, 4] + z * rows[i, 5], x * rows[i, 6] + y * rows[
        i, 7
    ] + z * rows[i, 8]


@njit(cache=True, error_model="numpy")
@no_type_check
def hit_patch(rows, i, o, d, density, ray):
    """Meet a patch; return t and what was met (wall, glass, nothing that answers, a room)."""
    slope = d[0] * rows[i, 9] + d[1] * rows[i, 10] + d[2] * rows[i, 11]
    if abs(slope) < 1e-9:
        return np.inf, SOLID
    above = (
        (rows[i, 0] - o[0]) * rows[i, 9]
        + (rows[i, 1] - o[1]) * rows[i, 10]
        + (rows[i, 2] - o[2]) * rows[i, 11]
    )
    t = above / slope
    if t <= 0.0:
        return np.inf, SOLID
    u, v = patch_coordinates(rows, i, o, d, t)
    cut = 0.5 * rows[i, 14] * rows[i, 12] * v / rows[i, 13]
    if v < 0.0 or v > rows[i, 13] or u < cut or u > rows[i, 12] - cut:
        return np.inf, SOLID
    if density > 0.0 and chance(ray[0], ray[1]) > density:
        return np.inf, SOLID
    if rows[i, 19] > 0.0:
        return window(rows, i, t, u, v, (slope, o, d, ray))
    return t, SOLID


@njit(cache=True, error_model="numpy")
@no_type_check
def window(rows, i, t, u, v, more):
    """Follow a ray that reached a wall with windows: wall, reveal, glass or the room behind."""
    slope, o, d, ray = more
    across = u - rows[i, 15] * np.floor(u / rows[i, 15]) - 0.5 * rows[i, 15]
    up = v - rows[i, 17] * np.floor(v / rows[i, 17]) - 0.55 * rows[i, 17]
    half_u, half_v = 0.5 * rows[i, 16], 0.5 * rows[i, 18]
    partial = u > rows[i, 12] - np.fmod(rows[i, 12], rows[i, 15]) or v > rows[i, 13] - np.fmod(
        rows[i, 13], rows[i, 17]
    )
    if abs(across) > half_u or abs(up) > half_v or partial:
        return t, SOLID
    behind = rows[i, 19] / abs(slope)
    du, dv = patch_coordinates(rows, i, o, d, t + behind)
    du, dv = du - u, dv - v
    share = 1.0
    if abs(across + du) > half_u:
        share = (half_u - across * np.sign(du)) / abs(du)
    if abs(up + dv) > half_v:
        share = min(share, (half_v - up * np.sign(dv)) / abs(dv))
    if share < 1.0:
        return t + share * behind, SOLID
    luck = chance(ray[0], ray[1] + 1)
    if luck < 0.25:
        return t + behind, LOST
    if luck < 0.4:
        return t + behind + 4.0 * chance(ray[0], ray[1] + 2), INSIDE
    return t + behind, GLASS

# ruff: noqa: ANN001, ANN201 - compiled code; numba infers the types
"""Where a ray meets the ground: compiled."""

from typing import no_type_check

import numpy as np
from numba import njit

KERB_RAMP_M = 0.04


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

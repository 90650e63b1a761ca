"""Which way gravity points, as what stands in a scan tells.

On a slope the ground's normal is not the way up: walls, poles and trunks stand along gravity there
as everywhere. A scan is cut into stacks, columns of half a metre and some height. How the returns
of one shift sideways with height is how it leans, known well across a wall and both ways at a pole.
The lean that most stacks share is that of the frame they are seen in.
"""

from typing import no_type_check

import numpy as np
from jaxtyping import Float64
from numba import njit

from sl3d_slam.geometry.ground import UP
from sl3d_slam.geometry.se3 import Points, rotation_between

STACK_M, STACK_HEIGHT_M, LOWEST_M = 0.5, 3.0, 0.3
HALF_WIDTH_M, NUM_STOREYS = 60.0, 4
SIZE = int(2 * HALF_WIDTH_M / STACK_M)
MIN_RETURNS, MIN_SPREAD_M = 6, 0.3  # of a stack: points, and the deviation of their heights
MAX_THICKNESS_M = 0.12
NOISE_M = 0.03
LEAN_SIGMA = 0.015  # of upright things, and of what stands before them
NARROWING = ((0.12, 0.09, 0.06, 0.04), (0.04, 0.03, 0.02))  # scales of the weights, in each frame
AGREE, COMPARABLE = 0.035, 0.25  # leans: of those that agree, of those that could
MIN_AGREEING, MIN_AGREEING_SHARE = 15.0, 0.25
LEVEL_RAD = np.radians(1.0)  # on level ground its normal is steadier than what stands on it


def gravity_up(
    points_lidar: Points, heights: Float64[np.ndarray, "N"], ground_up: Float64[np.ndarray, "3"]
) -> Float64[np.ndarray, "3"]:
    """Return the unit vector along which most of what stands in a scan stands, upwards.

    ``heights`` (N,) are those above the ground, whose normal is ``ground_up``. That is returned
    where too little stands to tell in every direction, where what stands does not agree (hedges),
    and where both differ by less than a degree. They may differ by up to 11 degrees.
    """
    up, lean, leans = ground_up, np.zeros(2), np.zeros((0, 4))
    for scales in NARROWING:  # a frame that is off cuts what leans in it: look again
        R_level_lidar = rotation_between(up, UP)
        leans = _leans(_sums(*_in_stacks(points_lidar, heights, R_level_lidar)))
        lean = _common_lean(leans, np.array(scales))
        up = R_level_lidar.T @ np.array([lean[0], lean[1], 1.0])
        up /= np.linalg.norm(up)
        if up @ ground_up > np.cos(0.5 * LEVEL_RAD):  # one look shows four fifths of a lean
            return ground_up
    if up @ ground_up > np.cos(LEVEL_RAD) or not _is_sure(leans, lean):
        return ground_up
    return up


def _is_sure(leans: Float64[np.ndarray, "E 4"], lean: Float64[np.ndarray, "2"]) -> bool:
    """Tell whether enough stacks share a lean, in every direction, and enough of all."""
    off = np.abs(leans[:, :2] @ lean - leans[:, 2])
    agreeing = leans[off < AGREE, :2]
    support = np.linalg.eigvalsh(agreeing.T @ agreeing)[0]
    share = len(agreeing) / max(1, int(np.sum(off < COMPARABLE)))
    return bool(support >= MIN_AGREEING and share >= MIN_AGREEING_SHARE)


@njit(cache=True, nogil=True)
@no_type_check
def _in_stacks(
    points: np.ndarray, heights: np.ndarray, R: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the points, turned by ``R``, that are in some stack (M, 3), and in which (M,)."""
    level, stack, count = np.empty((len(points), 3)), np.empty(len(points), np.int32), 0
    for i in range(len(points)):
        storey = (heights[i] - LOWEST_M) / STACK_HEIGHT_M
        if not 0.0 <= storey < NUM_STOREYS:
            continue
        for k in range(3):
            level[count, k] = (
                R[k, 0] * points[i, 0] + R[k, 1] * points[i, 1] + R[k, 2] * points[i, 2]
            )
        x = (level[count, 0] + HALF_WIDTH_M) / STACK_M
        y = (level[count, 1] + HALF_WIDTH_M) / STACK_M
        if 0.0 <= x < SIZE and 0.0 <= y < SIZE:
            stack[count] = (int(x) * SIZE + int(y)) * NUM_STOREYS + int(storey)
            count += 1
    return level[:count], stack[:count]


@njit(cache=True, nogil=True)
@no_type_check
def _sums(level: np.ndarray, stack: np.ndarray) -> np.ndarray:
    """Return the sums of 1, x, y, z, xx, yy, xy, xz, yz, zz over each stack with enough (S, 10)."""
    row = np.zeros(SIZE * SIZE * NUM_STOREYS, np.int32)
    for k in stack:
        row[k] += 1
    total = 0
    for k in range(len(row)):
        enough = row[k] >= MIN_RETURNS
        row[k] = total if enough else -1
        total += enough
    sums = np.zeros((total, 10))
    for i in range(len(stack)):
        if row[stack[i]] >= 0:
            x, y, z = level[i, 0], level[i, 1], level[i, 2]
            terms = (1.0, x, y, z, x * x, y * y, x * y, x * z, y * z, z * z)
            for k in range(10):
                sums[row[stack[i]], k] += terms[k]
    return sums


@njit(cache=True, nogil=True)
@no_type_check
def _leans(sums: np.ndarray) -> np.ndarray:
    """Return the directions seen from above in which a stack is thin, and how it leans along each.

    Rows (E, 4) are the unit vector x, y, the lean (metres sideways per metre of height) and its
    standard deviation.
    """
    found, count = np.empty((2 * len(sums), 4)), 0
    for s in sums:
        mean = s[1:4] / s[0]
        zz = s[9] / s[0] - mean[2] * mean[2]
        if zz < MIN_SPREAD_M**2:
            continue
        lean_x = (s[7] / s[0] - mean[0] * mean[2]) / zz
        lean_y = (s[8] / s[0] - mean[1] * mean[2]) / zz
        xx = s[4] / s[0] - mean[0] * mean[0] - lean_x * lean_x * zz
        yy = s[5] / s[0] - mean[1] * mean[1] - lean_y * lean_y * zz
        xy = s[6] / s[0] - mean[0] * mean[1] - lean_x * lean_y * zz
        angle = 0.5 * np.arctan2(2.0 * xy, xx - yy)
        root = np.sqrt(0.25 * (xx - yy) ** 2 + xy * xy)
        cut = _touches_its_border(mean[0], s[4] / s[0]) or _touches_its_border(mean[1], s[5] / s[0])
        for turn, sign in ((0.0, 1.0), (0.5 * np.pi, -1.0)):
            squared = max(0.5 * (xx + yy) + sign * root, 0.0)
            if squared < MAX_THICKNESS_M**2 and (sign < 0.0 or not cut):
                x, y = np.cos(angle + turn), np.sin(angle + turn)
                found[count, 0], found[count, 1] = x, y
                found[count, 2] = x * lean_x + y * lean_y
                found[count, 3] = np.sqrt((squared + NOISE_M**2) / (s[0] * zz))
                count += 1
    return found[:count]


@njit(cache=True)
@no_type_check
def _touches_its_border(mean: float, mean_square: float) -> bool:
    """Tell whether what a stack holds reaches, along x or y, to where the stack ends."""
    reach = 2.0 * np.sqrt(max(mean_square - mean * mean, 0.0))
    inside = (mean + HALF_WIDTH_M) % STACK_M
    return inside < reach or inside > STACK_M - reach


@njit(cache=True, nogil=True)
@no_type_check
def _common_lean(leans: np.ndarray, scales: np.ndarray) -> np.ndarray:
    """Return the lean (2,) that most share, from 0 with weights of narrowing scales."""
    lean = np.zeros(2)
    for scale in scales:
        xx = yy = 1.0 / LEAN_SIGMA**2  # without any it stays where it was
        xy, x, y = 0.0, xx * lean[0], yy * lean[1]
        for i in range(len(leans)):
            off = leans[i, 0] * lean[0] + leans[i, 1] * lean[1] - leans[i, 2]
            variance = leans[i, 3] ** 2
            root = 1.0 + off * off / (scale * scale + variance)
            weight = 1.0 / (root * root * (LEAN_SIGMA**2 + variance))
            xx += weight * leans[i, 0] ** 2
            yy += weight * leans[i, 1] ** 2
            xy += weight * leans[i, 0] * leans[i, 1]
            x += weight * leans[i, 0] * leans[i, 2]
            y += weight * leans[i, 1] * leans[i, 2]
        lean = np.array([yy * x - xy * y, xx * y - xy * x]) / (xx * yy - xy * xy)
    return lean

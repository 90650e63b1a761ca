"""The pose that lays surfaces on the voxels of others, and how well they then lie."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from sl3d_slam.geometry.gaussian_voxels import Surfaces, Voxels
from sl3d_slam.geometry.robust_gicp import normal_equations
from sl3d_slam.geometry.se3 import Transform, exp

FIRST_WIDTH, LAST_WIDTH = 16.0, 0.5  # of the kernel; a plane of two centimetres' noise costs 0.2
NARROWING = 0.25
MAX_STEPS = 20
LEAST_STEP_M = 1e-3
LEAST_STEP_RAD = np.radians(0.02)
LOOSE = np.diag(np.repeat([1e2, 1.0], 3))  # 0.1 rad and 1 m: where surfaces hold nothing at all


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceFit:
    """Where surfaces lie.

    Attributes
    ----------
    hessian : of the weighted cost, rotation first, at the source frame.
    misfit : weighted mean of the cost of a point.
    support : mean weight of a point, 0 for one that met no voxel: the share that lies well.
    rests : whether the pose came to rest.
    """

    T_target_source: Transform
    hessian: Float64[np.ndarray, "6 6"]
    misfit: float
    support: float
    rests: bool


def lay_on(voxels: Voxels, surfaces: Surfaces, T_led: Transform) -> SurfaceFit:
    """Lay surfaces on voxels from a pose some decimetres off at most.

    Voxelised GICP (Koide et al., ICRA 2021) by Gauss-Newton. The kernel of Geman and McClure
    narrows step by step (graduated non-convexity, Zhou et al., ECCV 2016), so that surfaces far
    off can still pull, and in the end count for nothing.
    """
    T_target_source, width, rests = np.ascontiguousarray(T_led), FIRST_WIDTH, False
    for _ in range(MAX_STEPS):
        hessian, gradient, cost, weight = normal_equations(
            *surfaces, voxels, T_target_source, width
        )
        step = -np.linalg.solve(hessian + LOOSE, gradient)
        T_target_source = T_target_source @ exp(step)
        rests = _is_small(step)
        if rests and width == LAST_WIDTH:
            break
        width = max(LAST_WIDTH, NARROWING * width)
    support = weight / max(len(surfaces.points), 1)
    return SurfaceFit(T_target_source, hessian, cost / max(weight, 1e-9), support, rests)


def _is_small(step: Float64[np.ndarray, "6"]) -> bool:
    turned_rad, moved_m = np.linalg.norm(step[:3]), np.linalg.norm(step[3:])
    return bool(turned_rad < LEAST_STEP_RAD and moved_m < LEAST_STEP_M)

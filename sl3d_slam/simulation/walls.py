"""Walls round the ground plan of a building, with their true vertical edges."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from sl3d_slam.simulation.primitives import NO_LINE, Material, SceneBuilder, Semantic, Windows
from sl3d_slam.types import LineKind

UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, slots=True, eq=False)
class Lot:
    """The ground plan of a building: front left corner, along the front, inwards; metres."""

    corner: Float64[np.ndarray, "2"]
    along: Float64[np.ndarray, "2"]
    inward: Float64[np.ndarray, "2"]
    width_m: float
    depth_m: float
    base_m: float

    def point(self, u: float, w: float, z: float) -> Float64[np.ndarray, "3"]:
        """Return the town position of u along the front, w inwards and z above the base."""
        xy = self.corner + u * self.along + w * self.inward
        return np.array([xy[0], xy[1], self.base_m + z])


def walls(
    builder: SceneBuilder,
    lot: Lot,
    outline: list[tuple[float, float]],
    look: tuple[float, Material, Windows, bool],
) -> None:
    """Put walls round an outline, each vertical edge a true line from the ground to the top."""
    top, material, windows, has_rim = look
    uprights = [
        builder.line(
            lot.point(u, w, 0.0), lot.point(u, w, top), LineKind.VERTICAL_EDGE, Semantic.BUILDING
        )
        for u, w in outline
    ]
    for k, (u, w) in enumerate(outline):
        nxt = (k + 1) % len(outline)
        start, end = lot.point(u, w, -0.6), lot.point(*outline[nxt], -0.6)
        length = float(np.linalg.norm(end - start))
        rim = NO_LINE
        if has_rim:
            rise = (top + 0.6) * UP
            rim = builder.line(start + rise, end + rise, LineKind.OTHER_EDGE, Semantic.BUILDING)
        glazed = windows if length > windows.pitch_u_m + 0.3 else None
        edges = (uprights[k], uprights[nxt], NO_LINE, rim)
        builder.patch((start, end - start, (top + 0.6) * UP), material, windows=glazed, edges=edges)

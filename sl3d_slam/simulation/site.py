"""Where something may stand: off every road, and not on something else."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float64

from sl3d_slam.simulation.ground import Ground, Positions
from sl3d_slam.simulation.network import Street
from sl3d_slam.simulation.primitives import SceneBuilder

CELL_M = 0.5


@dataclass(slots=True, eq=False)
class Site:
    """A town being built: the ground, what stands on it and which places are taken."""

    ground: Ground
    builder: SceneBuilder = field(default_factory=SceneBuilder)
    taken: Bool[np.ndarray, "J I"] = field(init=False)

    def __post_init__(self) -> None:
        """Start with nothing taken."""
        shape = (np.array(self.ground.grid.shape[:2]) * self.ground.spacing_m / CELL_M).astype(int)
        self.taken = np.zeros(tuple(shape), bool)

    def _cells(self, positions: Positions) -> tuple[np.ndarray, np.ndarray]:
        i, j = ((positions - self.ground.low) / CELL_M).astype(int).T
        return np.clip(j, 0, self.taken.shape[0] - 1), np.clip(i, 0, self.taken.shape[1] - 1)

    def is_free(self, positions: Positions, margin_m: float) -> bool:
        """Tell whether all positions are untaken and ``margin_m`` away from every road."""
        if self.taken[self._cells(positions)].any():
            return False
        return bool((self.ground.road_distance_m(positions) >= margin_m).all())

    def claim(self, positions: Positions) -> None:
        """Mark positions as taken."""
        self.taken[self._cells(positions)] = True

    def height_m(self, position: np.ndarray) -> float:
        """Return the height of the surface at one place."""
        return float(self.ground.height_m(np.asarray(position, float)[None, :2])[0])

    def place(self, position: np.ndarray, radius_m: float, margin_m: float) -> float | None:
        """Claim a disc; return the height of the ground there, or None where it is not free."""
        disc = position[:2] + radius_m * _DISC
        if not self.is_free(disc, margin_m):
            return None
        self.claim(disc)
        return self.height_m(position)


_ANGLES = np.arange(8) * np.pi / 4
_DISC = np.vstack([np.zeros((1, 2)), np.column_stack([np.cos(_ANGLES), np.sin(_ANGLES)])])


def rectangle(
    origin: Float64[np.ndarray, "2"], u: Float64[np.ndarray, "2"], v: Float64[np.ndarray, "2"]
) -> Positions:
    """Return positions every 0.4 m or closer that cover a parallelogram, borders included."""
    a = np.linspace(0, 1, int(np.linalg.norm(u) / 0.4) + 2)
    b = np.linspace(0, 1, int(np.linalg.norm(v) / 0.4) + 2)
    return (origin + a[:, None, None] * u + b[None, :, None] * v).reshape(-1, 2)


def beside(street: Street, index: float, side: int, offset_m: float) -> Float64[np.ndarray, "3"]:
    """Return x, y and heading at ``offset_m`` beyond the road's edge; side +1 left, -1 right."""
    nearest = int(np.clip(index, 0, len(street.points) - 1))
    row, rest = street.points[nearest], index - nearest
    away = side * (row[3] + offset_m)
    x = row[0] + rest * np.cos(row[2]) - away * np.sin(row[2])
    y = row[1] + rest * np.sin(row[2]) + away * np.cos(row[2])
    return np.array([x, y, row[2]])

"""The ground: one smooth height field under a road network, with kerbs and pavements."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64
from scipy.ndimage import gaussian_filter
from scipy.spatial import cKDTree

SENSOR_HEIGHT_M = 1.73
MARGIN_M = 135.0
KERB_M = 0.12
MAX_SLOPE = 0.12
Positions = Float64[np.ndarray, "N 2"]


@dataclass(frozen=True, slots=True, eq=False)
class Ground:
    """Heights on a square grid of ``spacing_m`` that starts at ``low`` (town frame, metres).

    ``grid[j, i]``: height without kerb, signed distance to the road's edge (negative on the road),
    height of the kerb, width of the pavement.
    """

    low: Float64[np.ndarray, "2"]
    spacing_m: float
    grid: Float32[np.ndarray, "J I 4"]

    @property
    def steepest(self) -> float:
        """Return the largest slope (rise over run) between neighbours of the grid, kerbs aside."""
        heights = self.grid[:, :, 0].astype(float)
        along_x, along_y = np.diff(heights, axis=1)[:-1], np.diff(heights, axis=0)[:, :-1]
        return float(
            np.sqrt(2.0) * max(np.abs(along_x).max(), np.abs(along_y).max()) / self.spacing_m
        )

    def _sample(self, positions: Positions, channel: int) -> Float64[np.ndarray, "N"]:
        scaled = (positions - self.low) / self.spacing_m
        upper = np.array([self.grid.shape[1], self.grid.shape[0]]) - 1.001
        scaled = np.clip(scaled, 0.0, upper)
        i, j = scaled.astype(int).T
        a, b = (scaled - np.floor(scaled)).T
        field = self.grid[:, :, channel]
        low = (1 - a) * field[j, i] + a * field[j, i + 1]
        high = (1 - a) * field[j + 1, i] + a * field[j + 1, i + 1]
        return (1 - b) * low + b * high

    def road_distance_m(self, positions: Positions) -> Float64[np.ndarray, "N"]:
        """Return the signed distance to the road's edge, negative on the road."""
        return self._sample(positions, 1)

    def height_m(self, positions: Positions) -> Float64[np.ndarray, "N"]:
        """Return the height of the surface, pavements included."""
        raised = np.clip(self._sample(positions, 1) / 0.04, 0.0, 1.0)
        return self._sample(positions, 0) + raised * self._sample(positions, 2)


def build_ground(
    samples: Float64[np.ndarray, "N 4"],
    hints: Float64[np.ndarray, "M 3"],
    rng: np.random.Generator,
) -> Ground:
    """Lay the ground under roads.

    Parameters
    ----------
    samples : x, y, half width and pavement width (0: no kerb) all along every road.
    hints : positions and heights that the ground follows, smoothed.
    rng : for the slopes and the unevenness.
    """
    spacing = 1.0
    low = np.floor(samples[:, :2].min(axis=0) - MARGIN_M)
    count = np.ceil((samples[:, :2].max(axis=0) + MARGIN_M - low) / spacing).astype(int) + 1
    x, y = np.meshgrid(
        low[0] + spacing * np.arange(count[0]), low[1] + spacing * np.arange(count[1])
    )
    nodes = np.column_stack([x.ravel(), y.ravel()])
    distance, pavement = _road_distance(samples, nodes)
    height = _smooth_height(hints, low, count) + _unevenness(count, rng)
    height = _limit_slope(height)
    radius = np.hypot(x, y)
    weight = np.clip((radius - 6.0) / 30.0, 0.0, 1.0)
    weight = weight * weight * (3.0 - 2.0 * weight)
    start = height[round(-low[1]), round(-low[0])]
    height = -SENSOR_HEIGHT_M + weight * (height - start)
    grid = np.stack(
        [
            height,
            distance.reshape(height.shape),
            np.where(pavement > 0.0, KERB_M, 0.0).reshape(height.shape),
            pavement.reshape(height.shape),
        ],
        axis=2,
    )
    return Ground(low, spacing, grid.astype(np.float32))


def _road_distance(
    samples: Float64[np.ndarray, "N 4"], nodes: Float64[np.ndarray, "K 2"]
) -> tuple[Float64[np.ndarray, "K"], Float64[np.ndarray, "K"]]:
    """Return the distance to the nearest road's edge and the pavement there."""
    away, nearest = cKDTree(samples[:, :2]).query(nodes, k=3)
    best = np.argmin(away - samples[nearest, 2], axis=1)
    rows = np.arange(len(nodes))
    nearest = nearest[rows, best]
    return away[rows, best] - samples[nearest, 2], samples[nearest, 3]


def _smooth_height(
    hints: Float64[np.ndarray, "M 3"], low: Float64[np.ndarray, "2"], count: np.ndarray
) -> Float64[np.ndarray, "J I"]:
    """Average the hinted heights with kernels of 8, 30 and 120 m, the finest where it has data."""
    cells = np.round(hints[:, :2] - low).astype(int)
    weight, total = np.zeros(count[::-1]), np.zeros(count[::-1])
    np.add.at(weight, (cells[:, 1], cells[:, 0]), 1.0)
    np.add.at(total, (cells[:, 1], cells[:, 0]), hints[:, 2])
    height = np.full(count[::-1], hints[:, 2].mean())
    for sigma in (120.0, 30.0, 8.0):
        density = gaussian_filter(weight, sigma, truncate=3.0, mode="constant")
        mean = gaussian_filter(total, sigma, truncate=3.0, mode="constant")
        trust = density / (density + 0.05 / sigma**2)
        height = (1 - trust) * height + trust * mean / np.maximum(density, 1e-12)
    return gaussian_filter(height, 6.0)


def _unevenness(count: np.ndarray, rng: np.random.Generator) -> Float64[np.ndarray, "J I"]:
    """Return gentle slopes and small bumps."""
    result = np.zeros(count[::-1])
    for sigma, amplitude in ((45.0, 0.8), (12.0, 0.08), (3.0, 0.015)):
        noise = gaussian_filter(rng.standard_normal(count[::-1]), sigma, truncate=3.0, mode="wrap")
        result += amplitude * noise / max(float(noise.std()), 1e-12)
    return result


def _limit_slope(height: Float64[np.ndarray, "J I"]) -> Float64[np.ndarray, "J I"]:
    """Smooth the field until nothing is steeper than MAX_SLOPE, and flatten it at last."""
    for sigma in (0.0, 6.0, 10.0, 16.0, 25.0):
        smooth = gaussian_filter(height, sigma) if sigma else height
        steepest = float(np.hypot(*np.gradient(smooth)).max())
        if steepest <= MAX_SLOPE:
            return smooth
    return smooth * MAX_SLOPE / steepest

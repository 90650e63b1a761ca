"""A revisit made of a one-way drive: out on the even scans, back on the odd ones.

The way back is driven in reverse order with the sensor turned by 180 degrees. The turn is gradual,
over 40 scans, because odometry cannot follow a sudden one.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64

from sl3d_slam.errors import InputError
from sl3d_slam.geometry.se3 import Transform, from_yaw, invert, transform_points
from sl3d_slam.io.dataset import Dataset
from sl3d_slam.types import Scan

TURN_SCANS = 40
SCAN_PERIOD_S = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class _OutAndBackScans:
    """Reads scan k of the made-up drive as a turned scan of the one-way drive."""

    source: Dataset
    order: tuple[int, ...]
    yaws_rad: Float64[np.ndarray, "K"]

    def __call__(self, start: int, stop: int) -> Iterator[Scan]:
        for index in range(start, min(stop, len(self.order))):
            position = self.order[index]
            (scan,) = self.source.iterate(position, position + 1)
            points = transform_points(invert(_turn(self.yaws_rad[index])), scan.points_lidar)
            yield Scan(index, SCAN_PERIOD_S * index, np.ascontiguousarray(points))


def out_and_back(source: Dataset, scans: int | None = None) -> Dataset:
    """Turn a one-way drive, or its first ``scans`` scans, into one that comes back.

    Scan k is taken with the sensor turned to its left by ``yaw(k)``: its points are
    ``R(yaw)^T p`` and its true pose ``T_world_lidar @ R(yaw)``. Point times are left out, since
    the way back runs against them.

    Raises
    ------
    InputError
        where the drive has fewer than three scans.
    """
    count = len(source) if scans is None else min(scans, len(source))
    if count < 3:
        raise InputError(f"{source.name}: {count} scans; out and back needs at least 3")
    order = out_and_back_order(count)
    yaws_rad = turn_yaws_rad(count)
    truth = source.truth
    if truth is not None:
        turns = np.stack([_turn(yaw) for yaw in yaws_rad])
        truth = truth[list(order)] @ turns
    return replace(
        source,
        name=f"{source.name} out and back",
        description=f"{source.description}, out on its even scans and back on its odd ones",
        num_scans=len(order),
        read_scans=_OutAndBackScans(source, order, yaws_rad),
        truth=truth,
    )


def out_and_back_order(count: int) -> tuple[int, ...]:
    """Return which scan of the one-way drive is taken when: even ones up, odd ones down."""
    last_odd = count - 1 - count % 2
    return (*range(0, count, 2), *range(last_odd, 0, -2))


def turn_yaws_rad(count: int) -> Float64[np.ndarray, "K"]:
    """Return how far the sensor is turned to its left at each scan: 0 to pi."""
    num_out = (count + 1) // 2
    since = np.arange(count) - num_out + 1
    return np.pi * np.clip(since / TURN_SCANS, 0.0, 1.0)


def _turn(yaw_rad: float) -> Transform:
    return from_yaw(yaw_rad, np.zeros(3))

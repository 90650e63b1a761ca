"""What the pipeline sees of any input: a count, streamed scans, and truth where it is known."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from sl3d_slam.geometry.se3 import Transform
from sl3d_slam.types import Scan


@dataclass(frozen=True, slots=True, eq=False)
class Dataset:
    """A sequence of scans that is read while it is used; nothing is kept.

    Attributes
    ----------
    name : short name for tables and file names.
    description : one sentence: what was opened and how.
    num_scans : how many scans the sequence has.
    read_scans : ``read_scans(start, stop)`` streams the scans with start <= index < stop.
    truth : (N, 4, 4) ``T_world_lidar`` of every scan, in the lidar frame, or None where unknown.
    T_cam_lidar : lidar to camera, or None where there is no calibration.
    simulated : whether the scans come from the simulator; figures on them are labelled so.
    warnings : sentences that the user should see, such as assumed time stamps.
    """

    name: str
    description: str
    num_scans: int
    read_scans: Callable[[int, int], Iterator[Scan]]
    truth: Float64[np.ndarray, "N 4 4"] | None = None
    T_cam_lidar: Transform | None = None
    simulated: bool = False
    warnings: tuple[str, ...] = ()

    def __len__(self) -> int:
        """Return the number of scans."""
        return self.num_scans

    def __iter__(self) -> Iterator[Scan]:
        """Stream all scans."""
        return self.iterate()

    def iterate(self, start: int = 0, stop: int | None = None) -> Iterator[Scan]:
        """Stream the scans with ``start <= index < stop``; ``stop`` None is the end."""
        last = self.num_scans if stop is None else min(stop, self.num_scans)
        return self.read_scans(max(start, 0), last)

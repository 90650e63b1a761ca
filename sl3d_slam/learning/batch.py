"""Two clouds of a pair as the network takes them in one pass."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float32, Int64
from torch import Tensor

from sl3d_slam.learning.prepared import PreparedScan
from sl3d_slam.lines.network.neighbours import skip_neighbours
from sl3d_slam.lines.network.settings import NetworkSettings


@dataclass(frozen=True, slots=True, eq=False)
class PairBatch:
    """Two clouds, one after the other; ``line_ids`` and ``kinds`` are per cloud.

    Attributes
    ----------
    points, neighbours : (M, 4) and (M, k) of both clouds, neighbour indices into all M.
    sizes : how many points each cloud has.
    line_ids : of each cloud, (M_c,).
    kinds : of each cloud, (L_c,).
    matches : (K, 2) rows of lines that are the same.
    """

    points: Float32[Tensor, "M 4"]
    neighbours: Int64[Tensor, "M k"]
    sizes: tuple[int, int]
    line_ids: tuple[Int64[Tensor, "M1"], Int64[Tensor, "M2"]]
    kinds: tuple[Int64[Tensor, "L1"], Int64[Tensor, "L2"]]
    matches: Int64[Tensor, "K 2"]


def make_batch(
    first: PreparedScan, second: PreparedScan, matches: np.ndarray, network: NetworkSettings
) -> PairBatch:
    """Find neighbours and join two clouds."""
    near = [
        skip_neighbours(scan.points, network.num_neighbours, network.stride)
        for scan in (first, second)
    ]
    ids = [torch.from_numpy(scan.line_ids.astype(np.int64)) for scan in (first, second)]
    kinds = [torch.from_numpy(scan.kinds.astype(np.int64)) for scan in (first, second)]
    return PairBatch(
        points=torch.from_numpy(np.concatenate([first.points, second.points])),
        neighbours=torch.from_numpy(np.concatenate([near[0], near[1] + len(first.points)])),
        sizes=(len(first.points), len(second.points)),
        line_ids=(ids[0], ids[1]),
        kinds=(kinds[0], kinds[1]),
        matches=torch.from_numpy(matches.astype(np.int64)),
    )

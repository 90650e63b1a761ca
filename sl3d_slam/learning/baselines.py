"""The networks that the scale-invariant segmentation is compared with, small ones in plain torch.

PointNet (Qi et al., CVPR 2017), PointNet++ (Qi et al., NeurIPS 2017) and vanilla DGCNN (Wang et
al., TOG 2019), each with about the width of ours and with the norm of its paper (batch norm). All
answer like the line network: logits (M, 2) of concatenated clouds.
"""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Float32
from scipy.spatial import cKDTree
from torch import Tensor, nn

from sl3d_slam.lines.network.feature_space import nearest_in_features
from sl3d_slam.lines.network.gather import gather_max
from sl3d_slam.lines.network.settings import NetworkSettings

Answer = tuple[Float32[Tensor, "M 2"], Float32[Tensor, "M 0"]]


class PointNet(nn.Module):
    """Each point by itself, and the maximum over its whole cloud."""

    def __init__(self, width: int = 64) -> None:
        super().__init__()
        self.local = _mlp(3, width, width)
        self.wide = _mlp(width, 2 * width, 4 * width)
        self.head = nn.Sequential(_mlp(5 * width, 2 * width, width), nn.Linear(width, 2))

    def forward(self, points: Tensor, neighbours: Tensor, cloud_sizes: Sequence[int]) -> Answer:
        """Return logits; neighbours are not used."""
        local = self.local(points)
        whole = _over_clouds(self.wide(local), cloud_sizes)
        return _answer(self.head(torch.cat([local, whole], dim=1)))


class Dgcnn(nn.Module):
    """Three EdgeConv blocks on positions, ``[p, q - p]``; neighbours are found again per block."""

    def __init__(self, width: int = 64, num_neighbours: int = 20) -> None:
        super().__init__()
        self.settings = NetworkSettings(num_neighbours=num_neighbours, stride=1)
        self.blocks = nn.ModuleList(
            [EdgeBlock(3, width), EdgeBlock(width, width), EdgeBlock(width, width)]
        )
        self.wide = _mlp(3 * width, 4 * width)
        self.head = nn.Sequential(_mlp(7 * width, 2 * width, width), nn.Linear(width, 2))

    def forward(self, points: Tensor, neighbours: Tensor, cloud_sizes: Sequence[int]) -> Answer:
        """Return logits; ``neighbours`` in space serve the first block."""
        outputs = [self.blocks[0](points, neighbours)]
        for block in self.blocks[1:]:
            nearest = nearest_in_features(outputs[-1], self.settings, list(cloud_sizes))
            outputs.append(block(outputs[-1], nearest))
        joined = torch.cat(outputs, dim=1)
        whole = _over_clouds(self.wide(joined), cloud_sizes)
        return _answer(self.head(torch.cat([joined, whole], dim=1)))


class EdgeBlock(nn.Module):
    """``relu(norm(max_j W1 x_i + W2 (x_j - x_i)))`` with batch norm, one product a point."""

    def __init__(self, channels_in: int, channels_out: int) -> None:
        super().__init__()
        self.centre = nn.Linear(channels_in, channels_out)
        self.edge = nn.Linear(channels_in, channels_out, bias=False)
        self.norm = nn.BatchNorm1d(channels_out)

    def forward(self, features: Tensor, neighbours: Tensor) -> Tensor:
        """Return the features of the next block."""
        edges = self.edge(features)
        own = self.centre(features) - edges
        return nn.functional.relu(self.norm(own + gather_max(edges, neighbours)))


class PointNet2(nn.Module):
    """Two set abstractions in balls of fixed radius, and back by interpolation."""

    radii = (0.1, 0.25)
    counts = (512, 128)
    in_ball = 24

    def __init__(self, width: int = 64) -> None:
        super().__init__()
        self.first = _mlp(3, width, width)
        self.second = _mlp(3 + width, 2 * width, 2 * width)
        self.back = _mlp(3 * width, width)
        self.points = _mlp(3 + width, width)
        self.head = nn.Sequential(_mlp(width, width), nn.Linear(width, 2))

    def forward(self, points: Tensor, neighbours: Tensor, cloud_sizes: Sequence[int]) -> Answer:
        """Return logits; neighbours are found here, in balls."""
        clouds = [cloud.numpy() for cloud in torch.split(points.detach(), list(cloud_sizes))]
        near = [farthest_points(cloud, self.counts[0]) for cloud in clouds]
        far = [farthest_points(cloud, self.counts[1]) for cloud in near]
        low = _abstracted(self.first, clouds, near, None, (self.radii[0], self.in_ball))
        high = _abstracted(self.second, near, far, low, (self.radii[1], self.in_ball))
        low = self.back(torch.cat([low, _interpolated(far, near, high)], dim=1))
        spread = _interpolated(near, clouds, low)
        return _answer(self.head(self.points(torch.cat([points, spread], dim=1))))


def farthest_points(points: np.ndarray, count: int) -> np.ndarray:
    """Return ``count`` points, each the farthest from those before; all where there are fewer."""
    if len(points) <= count:
        return points
    chosen, distance, latest = [], np.full(len(points), np.inf), 0
    for _ in range(count):
        chosen.append(latest)
        offset = points - points[latest]
        distance = np.minimum(distance, np.einsum("nd,nd->n", offset, offset))
        latest = int(distance.argmax())
    return points[chosen]


def _abstracted(
    mlp: nn.Module,
    clouds: list[np.ndarray],
    centres: list[np.ndarray],
    features: Tensor | None,
    ball: tuple[float, int],
) -> Tensor:
    """Return features of the centres: the maximum over what lies in the ball around each."""
    rows, offsets, begin = [], [], 0
    for cloud, centre in zip(clouds, centres, strict=True):
        reach = min(ball[1], len(cloud))
        gap, index = cKDTree(cloud).query(centre, reach, distance_upper_bound=ball[0])
        index = np.where(np.isfinite(gap), index, index[:, :1])  # the centre itself is the first
        offsets.append(cloud[index] - centre[:, None])
        rows.append(index + begin)
        begin += len(cloud)
    edges = torch.from_numpy(np.concatenate(offsets).astype(np.float32))
    if features is not None:
        edges = torch.cat([edges, features[torch.from_numpy(np.concatenate(rows))]], dim=2)
    flat = mlp(edges.flatten(0, 1))
    return flat.view(*edges.shape[:2], -1).amax(dim=1)


def _interpolated(sources: list[np.ndarray], targets: list[np.ndarray], features: Tensor) -> Tensor:
    """Return features of the targets from the three nearest sources, by inverse distance."""
    rows, weights, begin = [], [], 0
    for source, target in zip(sources, targets, strict=True):
        gap, index = cKDTree(source).query(target, min(3, len(source)))
        weight = 1.0 / np.maximum(gap, 1e-6)
        weights.append(weight / weight.sum(axis=1, keepdims=True))
        rows.append(index + begin)
        begin += len(source)
    share = torch.from_numpy(np.concatenate(weights).astype(np.float32))
    return (features[torch.from_numpy(np.concatenate(rows))] * share[..., None]).sum(dim=1)


def _over_clouds(features: Tensor, sizes: Sequence[int]) -> Tensor:
    """Return for each point the maximum over its cloud."""
    parts = torch.split(features, list(sizes))
    return torch.cat([part.amax(dim=0, keepdim=True).expand_as(part) for part in parts])


def _mlp(*channels: int) -> nn.Sequential:
    layers: list[nn.Module] = []
    for inward, outward in pairwise(channels):
        layers += [nn.Linear(inward, outward), nn.BatchNorm1d(outward), nn.ReLU()]
    return nn.Sequential(*layers)


def _answer(logits: Tensor) -> Answer:
    return logits, logits.new_zeros(len(logits), 0)

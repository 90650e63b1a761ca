"""Neighbours in feature space, as the paper's network recomputes them per block; costly."""

from collections.abc import Sequence

import torch
from jaxtyping import Float32, Int64
from torch import Tensor

from sl3d_slam.lines.network.settings import NetworkSettings

CHUNK = 1024


def nearest_in_features(
    features: Float32[Tensor, "M C"], settings: NetworkSettings, cloud_sizes: Sequence[int]
) -> Int64[Tensor, "M k"]:
    """Return each point's neighbours in feature space within its own cloud, nearest first."""
    found, begin = [], 0
    for cloud in torch.split(features.detach(), list(cloud_sizes)):
        reach = min(settings.stride * settings.num_neighbours, len(cloud))
        k = settings.num_neighbours
        ranks = torch.arange(k, device=cloud.device) * reach // k
        for chunk in torch.split(cloud, CHUNK):
            nearest = torch.cdist(chunk, cloud).topk(reach, largest=False).indices
            found.append(nearest[:, ranks] + begin)
        begin += len(cloud)
    return torch.cat(found)

"""The network: three EdgeConv blocks shared by a segmentation and a descriptor head.

After Zhao et al., SuperLine3D: Self-supervised Line Segmentation and Description for LiDAR Point
Cloud, ECCV 2022. Built for two CPU cores: neighbours found once, one product a point.
"""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float32, Int64
from torch import Tensor, nn

from sl3d_slam.lines.network.cells import find_cells
from sl3d_slam.lines.network.context import Context
from sl3d_slam.lines.network.edgeconv import EdgeConv, OffsetConv
from sl3d_slam.lines.network.feature_space import nearest_in_features
from sl3d_slam.lines.network.offsets import edge_inputs
from sl3d_slam.lines.network.settings import LINE, NetworkSettings
from sl3d_slam.lines.network.shapes import RINGS, num_inputs

__all__ = ["LINE", "SuperLine3D"]


class SuperLine3D(nn.Module):
    """Line logits and descriptors of the points of a scan.

    Offsets to neighbours are all it knows of where points are: where the sensor stands, and with
    ``axes="own"`` which way it looks, cannot matter.
    """

    def __init__(self, settings: NetworkSettings) -> None:
        super().__init__()
        self.settings = settings
        width = settings.width
        self.blocks = nn.ModuleList(
            [
                OffsetConv(num_inputs(settings), width),
                EdgeConv(width, width),
                EdgeConv(width, width),
            ]
        )
        self.context = Context(3 * width, width) if settings.context else None
        joined = (4 if settings.context else 3) * width
        self.segmentation = _head(joined, width, 2)
        self.descriptor = _head(joined, 2 * width, settings.descriptor_dim)
        self.surroundings = surroundings_layer(settings) if settings.surroundings else None

    def forward(
        self,
        points: Float32[Tensor, "M P"],
        neighbours: Int64[Tensor, "M k"],
        cloud_sizes: Sequence[int] | None = None,
    ) -> tuple[Float32[Tensor, "M 2"], Float32[Tensor, "M D"]]:
        """Return logits (background, line) and unit descriptors per point.

        ``points`` are x, y, z and, where the settings want heights, the height above the ground.
        Several clouds go in one pass as one concatenation, with neighbour indices offset to it and
        the clouds' sizes in ``cloud_sizes``; none sees another.
        """
        encoded = self.encode(points, neighbours, cloud_sizes)
        return self.segmentation(encoded), self.describe(encoded)

    def encode(
        self,
        points: Float32[Tensor, "M P"],
        neighbours: Int64[Tensor, "M k"],
        cloud_sizes: Sequence[int] | None = None,
    ) -> Float32[Tensor, "M E"]:
        """Return the features that both heads read."""
        device, sizes = points.device, [len(points)] if cloud_sizes is None else list(cloud_sizes)
        places = points.detach().cpu().numpy()
        inputs = edge_inputs(places, neighbours.cpu().numpy(), self.settings)
        outputs = [self.blocks[0](torch.from_numpy(inputs).to(device))]
        for block in self.blocks[1:]:
            if self.settings.neighbours == "features":
                neighbours = nearest_in_features(outputs[-1], self.settings, sizes)
            outputs.append(block(outputs[-1], neighbours))
        joined = torch.cat(outputs, dim=1)
        if self.context is None:
            return joined
        cells = find_cells(places[:, :3], np.repeat(np.arange(len(sizes)), sizes))
        return torch.cat([joined, self.context(joined, cells)], dim=1)

    def describe(self, encoded: Float32[Tensor, "M E"]) -> Float32[Tensor, "M D"]:
        """Return unit descriptors of encoded points; any subset of them will do."""
        return nn.functional.normalize(self.descriptor(encoded), dim=1)


def surroundings_layer(settings: NetworkSettings) -> nn.Linear:
    """Return a new layer over lines, for what :func:`~.surroundings.heard_around` gives."""
    return nn.Linear((1 + RINGS) * settings.descriptor_dim, settings.descriptor_dim)


def _head(channels_in: int, hidden: int, channels_out: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(channels_in, hidden), nn.ReLU(), nn.Linear(hidden, channels_out))

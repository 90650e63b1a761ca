"""The trained network as the extraction uses it: points in, numpy out."""

from pathlib import Path
from typing import TYPE_CHECKING, Union

import numpy as np
from jaxtyping import Float32

from sl3d_slam.lines.network.answer import Inference
from sl3d_slam.lines.network.compiled import CompiledModel
from sl3d_slam.lines.network.neighbours import skip_neighbours
from sl3d_slam.lines.network.settings import NetworkSettings
from sl3d_slam.lines.network.weights_format import Tensors, hash_of, read_weights

if TYPE_CHECKING:
    from sl3d_slam.lines.network.torch_model import TorchModel


class Network:
    """A network ready for use: compiled on the processor, with torch on any other device.

    Raises
    ------
    InputError
        where the weights cannot be used or torch does not know the device.
    """

    def __init__(self, weights: Path, device: str = "cpu") -> None:
        self.settings, tensors = read_weights(weights)
        self.name = f"superline3d-{hash_of(self.settings, tensors)}"
        self._model = _model(self.settings, tensors, device)

    def infer(self, points: Float32[np.ndarray, "M 4"]) -> Inference:
        """Return what the network makes of points.

        They are those of :func:`sl3d_slam.lines.network.sample.network_points`, levelled.
        """
        if len(points) == 0:
            nothing = np.zeros((0, self.settings.descriptor_dim), np.float32)
            return Inference(np.zeros(0, np.float32), lambda rows: nothing[rows])
        neighbours = skip_neighbours(points, self.settings.num_neighbours, self.settings.stride)
        return self._model.infer(points, neighbours)


def _model(
    settings: NetworkSettings, tensors: Tensors, device: str
) -> Union[CompiledModel, "TorchModel"]:
    if device == "cpu" and settings.neighbours == "space":
        return CompiledModel(settings, tensors)
    from sl3d_slam.lines.network.torch_model import TorchModel

    return TorchModel(settings, tensors, device)

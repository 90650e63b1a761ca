"""The trained network as the extraction uses it: points in, numpy out."""

from pathlib import Path
from typing import TYPE_CHECKING, Union

import numpy as np
from jaxtyping import Float32, Float64

from sl3d_slam.lines.network.answer import Inference
from sl3d_slam.lines.network.compiled import CompiledModel
from sl3d_slam.lines.network.neighbours import skip_neighbours
from sl3d_slam.lines.network.settings import NetworkSettings
from sl3d_slam.lines.network.surroundings import in_surroundings
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
        self._tensors = tensors
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

    def in_surroundings(
        self,
        descriptors: Float32[np.ndarray, "L D"],
        places_m: Float64[np.ndarray, "L 2"],
        scores: Float64[np.ndarray, "L"],
    ) -> Float32[np.ndarray, "L D"]:
        """Return what lines of these mean descriptors are known by; those where nothing is added.

        ``places_m`` are the lines seen from above, levelled.
        """
        if not self.settings.surroundings or len(descriptors) == 0:
            return descriptors
        return in_surroundings(descriptors, places_m, scores, self._tensors)


def _model(
    settings: NetworkSettings, tensors: Tensors, device: str
) -> Union[CompiledModel, "TorchModel"]:
    if device == "cpu" and settings.neighbours == "space":
        return CompiledModel(settings, tensors)
    from sl3d_slam.lines.network.torch_model import TorchModel

    return TorchModel(settings, tensors, device)

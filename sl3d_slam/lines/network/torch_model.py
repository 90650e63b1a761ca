"""The network on a device of torch's, or with neighbours in feature space."""

from functools import partial

import numpy as np
import torch
from jaxtyping import Float32, Int64

from sl3d_slam.errors import InputError
from sl3d_slam.lines.network.answer import Inference
from sl3d_slam.lines.network.model import LINE
from sl3d_slam.lines.network.settings import NetworkSettings
from sl3d_slam.lines.network.weights_file import with_weights
from sl3d_slam.lines.network.weights_format import Tensors


class TorchModel:
    """A network that torch runs; the same methods as :class:`~.compiled.CompiledModel`."""

    def __init__(self, settings: NetworkSettings, tensors: Tensors, device: str) -> None:
        try:
            self._device = torch.device(device)
            self._model = with_weights(settings, tensors).to(self._device)
        except (RuntimeError, AssertionError):
            raise InputError(f"device {device}: not one that torch can use here") from None

    def infer(
        self, points: Float32[np.ndarray, "M 4"], neighbours: Int64[np.ndarray, "M k"]
    ) -> Inference:
        """Return what the network makes of points and the neighbours that each looks at."""
        with torch.inference_mode():
            encoded = self._model.encode(
                torch.from_numpy(points).to(self._device),
                torch.from_numpy(neighbours).to(self._device),
            )
            probability = torch.softmax(self._model.segmentation(encoded), dim=1)[:, LINE]
        return Inference(probability.cpu().numpy(), partial(self._describe, encoded))

    def _describe(
        self, encoded: Float32[torch.Tensor, "M E"], rows: Int64[np.ndarray, "P"]
    ) -> Float32[np.ndarray, "P D"]:
        """Return the unit descriptors of some of the points."""
        with torch.inference_mode():
            chosen = encoded[torch.from_numpy(rows).to(self._device)]
            return self._model.describe(chosen).cpu().numpy()

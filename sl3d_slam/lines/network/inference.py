"""The trained network as the extraction uses it: points in, numpy out."""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32

from sl3d_slam.errors import InputError
from sl3d_slam.lines.network.model import LINE
from sl3d_slam.lines.network.neighbours import skip_neighbours
from sl3d_slam.lines.network.weights_file import load_weights, model_hash


class Network:
    """A network ready for use, on a device of torch's."""

    def __init__(self, weights: Path, device: str = "cpu") -> None:
        model = load_weights(weights)
        self.name = f"superline3d-{model_hash(model)}"
        self.settings = model.settings
        try:
            self._device = torch.device(device)
            self._model = model.to(self._device)
        except (RuntimeError, AssertionError):
            raise InputError(f"device {device}: not one that torch can use here") from None

    def infer(
        self, points: Float32[np.ndarray, "M 4"], min_probability: float
    ) -> tuple[Float32[np.ndarray, "M"], Float32[np.ndarray, "M D"]]:
        """Return line probabilities of points and descriptors of those above a probability.

        The descriptors of the others are zero. ``points`` are those of
        :func:`sl3d_slam.lines.network.sample.network_points`, levelled.
        """
        descriptors = np.zeros((len(points), self.settings.descriptor_dim), np.float32)
        if len(points) == 0:
            return np.zeros(0, np.float32), descriptors
        neighbours = skip_neighbours(points, self.settings.num_neighbours, self.settings.stride)
        with torch.inference_mode():
            encoded = self._model.encode(
                torch.from_numpy(points).to(self._device),
                torch.from_numpy(neighbours).to(self._device),
            )
            logits = self._model.segmentation(encoded)
            probability = torch.softmax(logits, dim=1)[:, LINE].cpu().numpy()
            likely = np.flatnonzero(probability > min_probability)
            rows = torch.from_numpy(likely).to(self._device)
            descriptors[likely] = self._model.describe(encoded[rows]).cpu().numpy()
        return probability, descriptors

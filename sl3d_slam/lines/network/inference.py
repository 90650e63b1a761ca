"""The trained network as the extraction uses it: points in, numpy out."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32, Int64

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

    def infer(self, points: Float32[np.ndarray, "M 4"]) -> "Inference":
        """Return what the network makes of points.

        They are those of :func:`sl3d_slam.lines.network.sample.network_points`, levelled.
        """
        if len(points) == 0:
            return Inference(np.zeros(0, np.float32), torch.zeros(0, 1))
        neighbours = skip_neighbours(points, self.settings.num_neighbours, self.settings.stride)
        with torch.inference_mode():
            encoded = self._model.encode(
                torch.from_numpy(points).to(self._device),
                torch.from_numpy(neighbours).to(self._device),
            )
            probability = torch.softmax(self._model.segmentation(encoded), dim=1)[:, LINE]
        return Inference(probability.cpu().numpy(), encoded)

    def describe(
        self, inference: "Inference", rows: Int64[np.ndarray, "P"]
    ) -> Float32[np.ndarray, "P D"]:
        """Return the unit descriptors of some of the points of an inference."""
        if len(rows) == 0:
            return np.zeros((0, self.settings.descriptor_dim), np.float32)
        with torch.inference_mode():
            chosen = inference.encoded[torch.from_numpy(rows).to(self._device)]
            return self._model.describe(chosen).cpu().numpy()


@dataclass(frozen=True, slots=True, eq=False)
class Inference:
    """Line probability per point, and the features that descriptors are made of on demand."""

    probability: Float32[np.ndarray, "M"]
    encoded: Float32[torch.Tensor, "M E"]

"""Weights to and from torch's network; the file itself is :mod:`weights_format`'s business."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import save as dump_tensors

from sl3d_slam.files import write_whole
from sl3d_slam.lines.network.model import SuperLine3D
from sl3d_slam.lines.network.settings import NetworkSettings
from sl3d_slam.lines.network.weights_format import (
    FORMAT,
    Tensors,
    hash_of,
    read_about,
    read_weights,
)

__all__ = ["FORMAT", "load_weights", "model_hash", "read_about", "save_weights", "with_weights"]


def save_weights(path: Path | str, model: SuperLine3D, about: Mapping[str, str]) -> None:
    """Write a model's weights and settings, and what is said about them; whole or not at all."""
    tensors = {
        name: value.detach().cpu().contiguous() for name, value in model.state_dict().items()
    }
    settings = model.settings.model_dump_json()
    header = {f"about.{key}": value for key, value in about.items()}
    header |= {"format": FORMAT, "settings": settings}
    write_whole(Path(path), dump_tensors(tensors, metadata=header))


def load_weights(path: Path | str) -> SuperLine3D:
    """Return the network of a weights file, on the CPU, ready for inference.

    Raises
    ------
    InputError
        as :func:`~sl3d_slam.lines.network.weights_format.read_weights` does.
    """
    return with_weights(*read_weights(path))


def with_weights(settings: NetworkSettings, tensors: Tensors) -> SuperLine3D:
    """Return the network of these settings and weights, on the CPU, ready for inference."""
    model = SuperLine3D(settings)
    # copies: arrays that were read belong to their file's bytes
    model.load_state_dict({name: torch.tensor(value) for name, value in tensors.items()})
    return model.eval()


def model_hash(model: SuperLine3D | Path | str) -> str:
    """Return eight hexadecimal digits that stand for a model: its settings and every weight."""
    if not isinstance(model, SuperLine3D):
        return hash_of(*read_weights(model))
    return hash_of(model.settings, _arrays(model))


def _arrays(model: SuperLine3D) -> dict[str, np.ndarray]:
    return {name: value.detach().cpu().numpy() for name, value in model.state_dict().items()}

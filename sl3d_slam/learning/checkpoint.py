"""Where a training run stands: weights, Adam's moments and the step, in one safetensors file.

Nothing else is needed, as what a step sees follows from the seed and its number alone.
"""

import json
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn

from sl3d_slam.errors import InputError
from sl3d_slam.files import write_whole

EXPECTED = "expected the checkpoint of this training"


def save_checkpoint(
    path: Path, model: nn.Module, optimiser: torch.optim.Optimizer, step: int, settings: str
) -> None:
    """Write a checkpoint whole; ``settings`` says what a resumed run must agree with."""
    tensors = {f"model.{name}": value for name, value in model.state_dict().items()}
    for index, state in optimiser.state_dict()["state"].items():
        tensors |= {f"adam.{index}.{name}": value for name, value in state.items()}
    contiguous = {name: value.detach().cpu().contiguous() for name, value in tensors.items()}
    about = {"about": json.dumps({"step": step, "settings": settings})}
    write_whole(path, save(contiguous, about))


def load_checkpoint(
    path: Path, model: nn.Module, optimiser: torch.optim.Optimizer, settings: str
) -> int:
    """Put a run back to where its checkpoint stands; return the number of steps done.

    Raises
    ------
    InputError
        where the file is missing, damaged, or of a run with other settings or another network.
    """
    about, tensors = _read(path)
    if about["settings"] != settings:
        raise InputError(
            f"{path}: made with other settings or data; expected those of this run, "
            "or name another folder"
        )
    weights, states = _sorted_out(tensors)
    try:
        model.load_state_dict(weights)
        optimiser.load_state_dict({**optimiser.state_dict(), "state": states})
    except (RuntimeError, KeyError, ValueError):
        raise InputError(f"{path}: holds another network; {EXPECTED}") from None
    return int(about["step"])


def _sorted_out(tensors: dict[str, Tensor]) -> tuple[dict[str, Tensor], dict[int, dict[str, Any]]]:
    weights: dict[str, Tensor] = {}
    states: dict[int, dict[str, Any]] = {}
    for name, value in tensors.items():
        part, _, rest = name.partition(".")
        if part == "model":
            weights[rest] = value
        else:
            index, _, key = rest.partition(".")
            states.setdefault(int(index), {})[key] = value
    return weights, states


def _read(path: Path) -> tuple[dict[str, Any], dict[str, Tensor]]:
    try:
        with safe_open(path, framework="pt") as file:
            about = json.loads(file.metadata()["about"])
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        return {"step": int(about["step"]), "settings": str(about["settings"])}, tensors
    except (OSError, SafetensorError, KeyError, TypeError, ValueError):
        raise InputError(f"{path}: missing or damaged; {EXPECTED}") from None

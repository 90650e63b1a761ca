"""A training run of a segmentation: Adam, a falling rate, checkpoints that resume to the bit.

What a step sees follows from its number alone, so a run needs no state but the weights, Adam's
moments and the step; they are kept as safetensors.
"""

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from pydantic import Field
from safetensors import SafetensorError
from safetensors.torch import load_file, save
from torch import nn

from sl3d_slam.config import Settings
from sl3d_slam.errors import InputError
from sl3d_slam.files import write_whole
from sl3d_slam.learning.segmentation import Sample, make_batch, segmentation_loss

SamplesOf = Callable[[int], Sequence[Sample]]
Progress = Callable[[str, int], None]
EXPECTED = "the checkpoint of this training run"


class FitSettings(Settings):
    """How long and how fast; the rate is halved ``halvings`` times, evenly over the run."""

    steps: int = Field(default=3000, ge=1)
    learning_rate: float = Field(default=1e-3, gt=0)
    halvings: int = Field(default=4, ge=0)
    warm_up: int = Field(default=20, ge=1)
    num_neighbours: int = Field(default=20, ge=2)
    stride: int = Field(default=4, ge=1)
    checkpoint_every: int = Field(default=50, ge=1)

    def rate(self, step: int) -> float:
        """Return the learning rate of a step."""
        halved = 0.5 ** ((self.halvings + 1) * step // self.steps)
        return self.learning_rate * halved * min((step + 1) / self.warm_up, 1.0)


def fit(
    network: nn.Module,
    samples_of: SamplesOf,
    settings: FitSettings,
    checkpoint: Path | None = None,
    progress: Progress = lambda note, steps: None,
) -> list[float]:
    """Train a network in place; return the loss of every step of this call.

    Where ``checkpoint`` exists the run goes on from there and ends as if it had never stopped.

    Raises
    ------
    InputError
        where the checkpoint is damaged or of another run.
    OutputError
        where it cannot be written.
    """
    optimiser = torch.optim.Adam(network.parameters(), lr=settings.learning_rate)
    step = 0
    if checkpoint is not None and checkpoint.is_file():
        step = _resume(checkpoint, network, optimiser, settings)
        progress("resumed", step)
    losses = []
    network.train()
    while step < settings.steps:
        losses.append(_take_step(network, optimiser, samples_of(step), settings, step))
        step += 1
        progress(f"loss {sum(losses[-50:]) / len(losses[-50:]):.4f}", 1)
        due = step % settings.checkpoint_every == 0 or step == settings.steps
        if checkpoint is not None and due:
            _keep(checkpoint, network, optimiser, settings, step)
    network.eval()
    return losses


def _take_step(
    network: nn.Module,
    optimiser: torch.optim.Adam,
    samples: Sequence[Sample],
    settings: FitSettings,
    step: int,
) -> float:
    batch = make_batch([s.points for s in samples], settings.num_neighbours, settings.stride)
    for group in optimiser.param_groups:
        group["lr"] = settings.rate(step)
    optimiser.zero_grad(set_to_none=True)
    loss = segmentation_loss(network(batch.points, batch.neighbours, batch.sizes)[0], samples)
    loss.backward()  # type: ignore[no-untyped-call]
    nn.utils.clip_grad_norm_(network.parameters(), 1.0)
    optimiser.step()
    return float(loss.detach())


def _keep(
    path: Path,
    network: nn.Module,
    optimiser: torch.optim.Adam,
    settings: FitSettings,
    step: int,
) -> None:
    tensors = {f"network.{name}": value for name, value in network.state_dict().items()}
    for index, state in optimiser.state_dict()["state"].items():
        tensors |= {f"adam.{index}.{name}": value for name, value in state.items()}
    about = {"step": str(step), "fit": settings.model_dump_json()}
    contiguous = {name: value.detach().contiguous() for name, value in tensors.items()}
    write_whole(path, save(contiguous, about))


def _resume(
    path: Path, network: nn.Module, optimiser: torch.optim.Adam, settings: FitSettings
) -> int:
    about, tensors = _read(path)
    if about.get("fit") != settings.model_dump_json():
        raise InputError(f"{path}: was made with other settings; name another folder or remove it")
    states: dict[int, dict[str, Any]] = {}
    weights = {}
    for name, value in tensors.items():
        part, _, rest = name.partition(".")
        if part == "network":
            weights[rest] = value
            continue
        index, _, key = rest.partition(".")
        states.setdefault(int(index), {})[key] = value
    try:
        network.load_state_dict(weights)
    except RuntimeError:
        raise InputError(f"{path}: holds another network; expected {EXPECTED}") from None
    optimiser.load_state_dict({**optimiser.state_dict(), "state": states})
    return int(about["step"])


def _read(path: Path) -> tuple[dict[str, str], dict[str, torch.Tensor]]:
    from safetensors import safe_open

    try:
        with safe_open(path, framework="pt") as file:
            about = dict(file.metadata() or {})
        tensors = load_file(path)
    except (SafetensorError, OSError, json.JSONDecodeError):
        raise InputError(f"{path}: cannot be read; expected {EXPECTED}") from None
    return about, tensors

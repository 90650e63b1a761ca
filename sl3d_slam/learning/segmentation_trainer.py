"""A training run of a segmentation: Adam, a falling rate, checkpoints that resume to the bit.

What a step sees follows from its number alone.
"""

from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from pydantic import Field
from torch import nn

from sl3d_slam.config import Settings
from sl3d_slam.learning.checkpoint import load_checkpoint, save_checkpoint
from sl3d_slam.learning.segmentation import Sample, make_batch, segmentation_loss

SamplesOf = Callable[[int], Sequence[Sample]]
Progress = Callable[[str, int], None]


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
        step = load_checkpoint(checkpoint, network, optimiser, settings.model_dump_json())
        progress("resumed", step)
    losses = []
    network.train()
    while step < settings.steps:
        losses.append(_take_step(network, optimiser, samples_of(step), settings, step))
        step += 1
        progress(f"loss {sum(losses[-50:]) / len(losses[-50:]):.4f}", 1)
        due = step % settings.checkpoint_every == 0 or step == settings.steps
        if checkpoint is not None and due:
            save_checkpoint(checkpoint, network, optimiser, step, settings.model_dump_json())
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

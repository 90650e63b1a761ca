"""The joint training: pairs in, weights out; a killed run goes on as if nothing had happened."""

import csv
import io
import json
import math
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from torch import nn

from sl3d_slam.errors import InputError
from sl3d_slam.files import prepare_run_folder, write_whole
from sl3d_slam.learning.checkpoint import load_checkpoint, save_checkpoint
from sl3d_slam.learning.joint_loss import TERMS, pair_losses, total_loss
from sl3d_slam.learning.joint_settings import JointSettings
from sl3d_slam.learning.pair_source import PairSource
from sl3d_slam.learning.parallel import Team
from sl3d_slam.learning.prepared import PreparedDrive
from sl3d_slam.lines.network.model import SuperLine3D
from sl3d_slam.lines.network.weights_file import save_weights

CHECKPOINT, CURVES, WEIGHTS = "checkpoint.safetensors", "curves.csv", "weights.safetensors"
COLUMNS = ("step", "learning_rate", "loss", *TERMS)
MAX_GRADIENT = 1.0
Progress = Callable[[str, int], None]


class JointTraining:
    """One run, in one folder: ``checkpoint.safetensors``, ``curves.csv``, ``weights.safetensors``.

    Example
    -------
    >>> training = JointTraining(SuperLine3D(NetworkSettings()), drives, JointSettings(), out)
    >>> training.run()
    """

    def __init__(
        self,
        model: SuperLine3D,
        drives: Sequence[PreparedDrive],
        settings: JointSettings,
        out: Path,
        team: Team = Team(),  # noqa: B008  (frozen)
        singles: Sequence[PreparedDrive] = (),
    ) -> None:
        """Take the folder into use; nothing is trained yet."""
        self.model, self.settings, self._team = model, settings, team
        self._out = prepare_run_folder(out)
        self._source = PairSource(drives, settings, model.settings, singles)
        self._optimiser = torch.optim.Adam(model.parameters(), lr=settings.learning_rate)
        self._agreed = json.dumps(
            {
                "settings": settings.model_dump(),
                "network": model.settings.model_dump(),
                "drives": [[drive.name, len(drive.scans)] for drive in (*drives, *singles)],
                "processes": team.size,
            }
        )
        self.step = 0
        self._rows: list[list[float]] = []

    @property
    def num_pairs(self) -> int:
        """How many pairs there are to learn from."""
        return self._source.num_pairs

    def resume(self) -> None:
        """Go on where the checkpoint of the folder stands. Raises InputError."""
        self.step = load_checkpoint(
            self._out / CHECKPOINT, self.model, self._optimiser, self._agreed
        )
        self._rows = [row for row in read_curves(self._out / CURVES) if row[0] <= self.step]

    def run(
        self,
        progress: Progress = lambda note, steps: None,
        checkpoint_every: int = 100,
        stop: int | None = None,
        look: Callable[[int], None] = lambda _: None,
    ) -> None:
        """Train to the end, or to step ``stop``; ``look`` is called after each checkpoint."""
        last = self.settings.steps if stop is None else min(stop, self.settings.steps)
        self.model.train()
        while self.step < last:
            row = self._take_step()
            self.step += 1
            self._rows.append([float(self.step), *row])
            progress(f"loss {row[1]:.3f}", 1)
            if self.step % checkpoint_every == 0 or self.step == last:
                self._keep()
                look(self.step)
                self.model.train()
        self.model.eval()

    def _take_step(self) -> list[float]:
        """Learn from one step's pairs; return the learning rate and the losses."""
        rate = learning_rate(self.step, self.settings)
        for group in self._optimiser.param_groups:
            group["lr"] = rate
        self._optimiser.zero_grad(set_to_none=True)
        seen = torch.zeros(1 + len(TERMS))
        for index in range(self.settings.pairs_per_step):
            position = self.step * self._team.size + self._team.rank
            batch = self._source.draw(position * self.settings.pairs_per_step + index)
            terms = pair_losses(self.model, batch, self.settings.loss)
            loss = total_loss(terms, self.settings.loss) / self.settings.pairs_per_step
            loss.backward()  # type: ignore[no-untyped-call]
            share = torch.stack([loss, *(terms[name] for name in TERMS)]).detach()
            seen += share / torch.tensor([1.0, *[self.settings.pairs_per_step] * len(TERMS)])
        self._team.average_gradients(self.model)
        nn.utils.clip_grad_norm_(self.model.parameters(), MAX_GRADIENT)
        self._optimiser.step()
        return [rate, *self._team.average(seen).tolist()]

    def _keep(self) -> None:
        if not self._team.leads:
            return
        save_checkpoint(
            self._out / CHECKPOINT, self.model, self._optimiser, self.step, self._agreed
        )
        write_curves(self._out / CURVES, self._rows)
        about = {"made_by": "sl3d train joint", "step": str(self.step), "run": self._agreed}
        save_weights(self._out / WEIGHTS, self.model, about)


def learning_rate(step: int, settings: JointSettings) -> float:
    """Return the rate of a step: a short rise, then half a cosine down to a hundredth.

    The paper halves it every 15 of 120 epochs, to 1/128 at the end: the same fall in steps.
    """
    return settings.learning_rate * share_of_rate(step, settings.steps, settings.warmup_steps)


def share_of_rate(step: int, steps: int, warmup_steps: int) -> float:
    """Return the share of the highest rate that a step of so many is given."""
    rise = min(1.0, (step + 1) / max(warmup_steps, 1))
    fall = 0.5 * (1.0 + math.cos(math.pi * step / steps))
    return rise * (0.01 + 0.99 * fall)


def write_curves(path: Path, rows: Sequence[Sequence[float | int]]) -> None:
    """Write one row a step under the names of the columns."""
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(COLUMNS)
    table.writerows([int(row[0]), *(f"{value:.6g}" for value in row[1:])] for row in rows)
    write_whole(path, text.getvalue())


def read_curves(path: Path) -> list[list[float]]:
    """Return the rows of a curves file; none where there is no file. Raises InputError."""
    if not path.is_file():
        return []
    try:
        header, *rows = csv.reader(path.read_text(encoding="utf-8").splitlines())
        if tuple(header) != COLUMNS:
            raise ValueError
        return [[float(value) for value in row] for row in rows]
    except (OSError, ValueError):
        raise InputError(f"{path}: expected the curves of a training run") from None

"""Teaches the layer in which lines hear of the lines around them; the rest of the network stays.

What is learned from is what will be met: lines as the extraction finds them, right and wrong, and
of the same place from two others.
"""

from collections.abc import Callable, Sequence

import numpy as np
import torch
from jaxtyping import Float32, Int64
from pydantic import Field
from torch import Tensor, nn

from sl3d_slam.config import Settings
from sl3d_slam.errors import InputError
from sl3d_slam.learning.joint import share_of_rate
from sl3d_slam.learning.line_drives import LineDrive, LinePair, LinePairs
from sl3d_slam.learning.losses import contrast_loss
from sl3d_slam.lines.network.model import SuperLine3D
from sl3d_slam.lines.network.surroundings import heard_around
from sl3d_slam.types import LineSet

Progress = Callable[[str, int], None]


class SurroundingsSettings(Settings):
    """How the layer is taught.

    Of each scan the best ``min_lines`` or more count, of which up to the share ``max_lost`` is
    lost by chance; places are off by ``place_noise_m``. ``descriptor_noise`` is how long a vector
    is added to the unit descriptors: on streets that the network learned from they are better than
    they will be elsewhere.
    """

    steps: int = Field(default=3000, ge=1)
    pairs_per_step: int = Field(default=6, ge=1)
    learning_rate: float = Field(default=5e-3, gt=0)
    warmup_steps: int = Field(default=30, ge=0)
    seed: int = Field(default=0, ge=0)
    real_share: float = Field(default=0.2, ge=0, le=1)
    max_pair_distance_m: float = Field(default=30.0, gt=0)
    match_distance_m: float = Field(default=0.3, gt=0)
    temperature: float = Field(default=0.07, gt=0)
    min_lines: int = Field(default=30, ge=1)
    max_lost: float = Field(default=0.2, ge=0, lt=1)
    descriptor_noise: float = Field(default=0.6, ge=0)
    place_noise_m: float = Field(default=0.1, ge=0)


def learn_surroundings(
    model: SuperLine3D,
    drives: Sequence[LineDrive],
    settings: SurroundingsSettings,
    progress: Progress = lambda note, steps: None,
) -> SuperLine3D:
    """Return the network with a layer that was taught on the lines that it found along drives.

    Raises
    ------
    InputError
        where no drive has two scans close enough.
    """
    pairs = [LinePairs(d, settings.match_distance_m, settings.max_pair_distance_m) for d in drives]
    pairs = [found for found in pairs if len(found)]
    if not pairs:
        raise InputError(
            f"no two scans of one drive lie within {settings.max_pair_distance_m:g} m; "
            "expected a drive of overlapping scans"
        )
    torch.manual_seed(settings.seed)
    taught = with_surroundings(model)
    layer = taught.surroundings
    assert layer is not None
    optimiser = torch.optim.Adam(layer.parameters(), lr=settings.learning_rate)
    rng = np.random.default_rng(settings.seed)
    for step in range(settings.steps):
        share = share_of_rate(step, settings.steps, settings.warmup_steps)
        optimiser.param_groups[0]["lr"] = settings.learning_rate * share
        optimiser.zero_grad()
        drawn = [_drawn(pairs, settings.real_share, rng) for _ in range(settings.pairs_per_step)]
        losses = [_loss(layer, pair, settings, rng) for pair in drawn]
        loss = torch.stack(losses).mean()
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()
        progress(f"loss {loss.item():.3f}", 1)
    return taught.eval()


def with_surroundings(model: SuperLine3D) -> SuperLine3D:
    """Return a network of the same weights whose layer over lines is new."""
    grown = SuperLine3D(model.settings.model_copy(update={"surroundings": True}))
    grown.load_state_dict({**grown.state_dict(), **without_surroundings(model).state_dict()})
    return grown


def without_surroundings(model: SuperLine3D) -> SuperLine3D:
    """Return a network of the same weights that has no layer over lines."""
    bare = SuperLine3D(model.settings.model_copy(update={"surroundings": False}))
    wanted = bare.state_dict().keys()
    bare.load_state_dict({k: value for k, value in model.state_dict().items() if k in wanted})
    return bare


def _drawn(pairs: Sequence[LinePairs], real_share: float, rng: np.random.Generator) -> LinePair:
    """Draw a drive, real or simulated as the share says where there are both, and a pair of it."""
    simulated = np.array([found.drive.simulated for found in pairs])
    if simulated.any() and not simulated.all():
        kind = simulated == (rng.random() >= real_share)
    else:
        kind = np.ones(len(pairs), bool)
    return pairs[int(rng.choice(np.flatnonzero(kind)))].draw(rng)


def _loss(
    layer: nn.Linear, pair: LinePair, settings: SurroundingsSettings, rng: np.random.Generator
) -> Tensor:
    """Return how badly the lines of a pair are told apart, each scan changed by chance."""
    kept, known = [], []
    for lines in (pair.first, pair.second):
        rows = _kept_rows(len(lines), settings, rng)
        kept.append(rows)
        known.append(layer(torch.from_numpy(_heard(lines.take(rows), settings, rng))))
    rows_of = [np.full(len(lines), -1) for lines in (pair.first, pair.second)]
    for row_of, rows in zip(rows_of, kept, strict=True):
        row_of[rows] = np.arange(len(rows))
    matches = np.stack([rows_of[side][pair.matches[:, side]] for side in (0, 1)], axis=1)
    matches = matches[(matches >= 0).all(axis=1)]
    return contrast_loss(known[0], known[1], torch.from_numpy(matches), settings.temperature)


def _kept_rows(
    count: int, settings: SurroundingsSettings, rng: np.random.Generator
) -> Int64[np.ndarray, "K"]:
    """Draw how many of the best lines there are and which of them are lost; one stays."""
    best = int(rng.integers(min(settings.min_lines, count), count + 1))
    lost = rng.random(best) < rng.uniform(0.0, settings.max_lost)
    rows = np.flatnonzero(~lost)
    return rows if len(rows) else np.zeros(min(count, 1), np.int64)


def _heard(
    lines: LineSet, settings: SurroundingsSettings, rng: np.random.Generator
) -> Float32[np.ndarray, "L E"]:
    """Return what the layer sees of lines whose descriptors and places are off a little."""
    count, size = lines.descriptors.shape
    noise = rng.normal(0.0, settings.descriptor_noise / np.sqrt(size), (count, size))
    descriptors = lines.descriptors + noise
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    places_m = lines.endpoints.mean(axis=1)[:, :2]
    places_m = places_m + rng.normal(0.0, settings.place_noise_m, (count, 2))
    return heard_around(descriptors.astype(np.float32), places_m, lines.scores)

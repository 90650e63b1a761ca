"""Training of the line segmentation alone: samples, loss, figures."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float32, Int64, UInt8
from torch import Tensor, nn

from sl3d_slam.lines.network.neighbours import skip_neighbours

# points, neighbours and sizes of clouds -> logits (M, 2) of background and line, and anything else
PointNetwork = Callable[[Tensor, Tensor, Sequence[int]], tuple[Tensor, Tensor]]

NUM_KINDS = 4
BACKGROUND_SHARE = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class Sample:
    """One cloud to learn from.

    Attributes
    ----------
    points : (M, 3) in any unit.
    on_line : (M,) whether a point lies on a line.
    weights : (M,) how much each point counts in the loss; 0 where the truth is not known.
    """

    points: Float32[np.ndarray, "M 3"]
    on_line: Bool[np.ndarray, "M"]
    weights: Float32[np.ndarray, "M"]


@dataclass(frozen=True, slots=True, eq=False)
class Batch:
    """Several clouds as one: neighbours (M, k) point into the concatenation."""

    points: Float32[Tensor, "M 3"]
    neighbours: Int64[Tensor, "M k"]
    sizes: tuple[int, ...]


def kind_weights(kinds: Sequence[UInt8[np.ndarray, "_"]]) -> Float32[np.ndarray, "4"]:
    """Return a weight a kind so that background has half of the loss and every line kind a share.

    Each kind of line that occurs gets as much as any other, however few its points: a pole is a
    handful of points, an edge ten times as many. The mean weight of a point is 1.
    """
    count = np.bincount(np.concatenate([*kinds, np.zeros(0, np.uint8)]), minlength=NUM_KINDS)
    present = count[1:] > 0
    share = np.zeros(NUM_KINDS)
    share[0] = BACKGROUND_SHARE if present.any() else 1.0
    share[1:][present] = (1.0 - share[0]) / max(int(present.sum()), 1)
    return (share * count.sum() / np.maximum(count, 1)).astype(np.float32)


def make_batch(clouds: Sequence[np.ndarray], num_neighbours: int, stride: int) -> Batch:
    """Find the neighbours of each cloud and join the clouds."""
    found, begin = [], 0
    for points in clouds:
        found.append(skip_neighbours(points, num_neighbours, stride) + begin)
        begin += len(points)
    joined = np.concatenate(clouds).astype(np.float32)
    neighbours = torch.from_numpy(np.concatenate(found))
    return Batch(torch.from_numpy(joined), neighbours, tuple(len(points) for points in clouds))


def segmentation_loss(
    logits: Float32[Tensor, "M 2"], samples: Sequence[Sample]
) -> Float32[Tensor, ""]:
    """Return the weighted cross-entropy, averaged over the weight."""
    target = torch.from_numpy(np.concatenate([s.on_line for s in samples]).astype(np.int64))
    weights = torch.from_numpy(np.concatenate([s.weights for s in samples]))
    losses = nn.functional.cross_entropy(logits, target, reduction="none")
    return (losses * weights).sum() / weights.sum().clamp(min=1e-6)


@dataclass(frozen=True, slots=True)
class Agreement:
    """Points by prediction and truth, summed over clouds."""

    true_lines: int = 0
    false_lines: int = 0
    missed_lines: int = 0
    true_background: int = 0

    def plus(self, found: np.ndarray, truth: np.ndarray) -> "Agreement":
        """Return the counts with one more cloud's; both arguments are masks."""
        return Agreement(
            self.true_lines + int((found & truth).sum()),
            self.false_lines + int((found & ~truth).sum()),
            self.missed_lines + int((~found & truth).sum()),
            self.true_background + int((~found & ~truth).sum()),
        )

    @property
    def accuracy(self) -> float:
        """Share of points that are told right."""
        right = self.true_lines + self.true_background
        return right / max(right + self.false_lines + self.missed_lines, 1)

    @property
    def mean_iou(self) -> float:
        """Intersection over union, the mean of both classes."""
        wrong = self.false_lines + self.missed_lines
        lines = self.true_lines / max(self.true_lines + wrong, 1)
        background = self.true_background / max(self.true_background + wrong, 1)
        return 0.5 * (lines + background)

    @property
    def precision(self) -> float:
        """Share of the points called line that are."""
        return self.true_lines / max(self.true_lines + self.false_lines, 1)

    @property
    def recall(self) -> float:
        """Share of the points on lines that are called so."""
        return self.true_lines / max(self.true_lines + self.missed_lines, 1)


def line_shares(
    network: PointNetwork, clouds: Sequence[np.ndarray], num_neighbours: int, stride: int
) -> list[Float32[np.ndarray, "_"]]:
    """Return the probability of being on a line for every point of every cloud."""
    batch = make_batch(clouds, num_neighbours, stride)
    with torch.no_grad():
        logits = network(batch.points, batch.neighbours, batch.sizes)[0]
    shares = torch.softmax(logits, dim=1)[:, 1].numpy()
    return np.split(shares, np.cumsum(batch.sizes)[:-1])

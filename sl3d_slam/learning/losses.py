"""The losses of the joint training (SuperLine3D, section 3.2) and one that ranks.

Shapes: M points, L lines of one cloud, D descriptor.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float32, Int64
from torch import Tensor
from torch.nn.functional import cross_entropy

from sl3d_slam.learning.joint_settings import LossSettings
from sl3d_slam.learning.prepared import BACKGROUND
from sl3d_slam.types import LineKind

EDGES = (LineKind.VERTICAL_EDGE, LineKind.OTHER_EDGE)


class LineMeans(NamedTuple):
    """Mean descriptors ``mu`` (L, D) of the lines that have points, and each line's row in them.

    ``row_of`` is -1 for a line without points.
    """

    mu: Float32[Tensor, "L D"]
    row_of: Int64[Tensor, "K"]


def segmentation_loss(
    logits: Float32[Tensor, "M 2"],
    line_ids: Int64[Tensor, "M"],
    kinds: Int64[Tensor, "L"],
    settings: LossSettings,
) -> Float32[Tensor, ""]:
    """Return the cross-entropy of line against background, each kind of line with its own weight.

    Background points share ``background_share`` of the weight; poles, edges and lines of unknown
    kind share the rest evenly between the kinds that occur, so that a few poles count as much as
    many edges. Points that are not known (below -1) do not count.
    """
    groups = _groups(line_ids, kinds)
    share = torch.zeros(groups.shape[1], dtype=logits.dtype)
    present = groups.any(dim=1)
    num_line_kinds = int(present[1:].sum())
    for row, members in enumerate(groups):
        count = int(members.sum())
        if count:
            line_share = (1.0 - settings.background_share) / max(num_line_kinds, 1)
            total = settings.background_share if row == 0 else line_share
            share[members] = total / count
    wanted = (line_ids >= 0).long()
    return (share * cross_entropy(logits, wanted, reduction="none")).sum()


def _groups(line_ids: Tensor, kinds: Tensor) -> Tensor:
    """Return which points are background, on poles, on edges, on lines of unknown kind."""
    on_line = line_ids >= 0
    kind = torch.full_like(line_ids, -1)
    kind[on_line] = kinds[line_ids[on_line]]
    edge = (kind == int(EDGES[0])) | (kind == int(EDGES[1]))
    pole = kind == int(LineKind.POLE)
    return torch.stack([line_ids == BACKGROUND, pole, edge, on_line & ~pole & ~edge])


def line_means(
    descriptors: Float32[Tensor, "M D"], line_ids: Int64[Tensor, "M"], num_lines: int
) -> LineMeans:
    """Return the mean descriptor of every line that has a point; the last line counts too."""
    on_line = line_ids >= 0
    ids = line_ids[on_line]
    counts = torch.bincount(ids, minlength=num_lines)
    sums = descriptors.new_zeros(num_lines, descriptors.shape[1])
    sums = sums.index_add(0, ids, descriptors[on_line])
    has_points = counts > 0
    row_of = torch.where(has_points, torch.cumsum(has_points.long(), 0) - 1, -1)
    return LineMeans(sums[has_points] / counts[has_points, None], row_of)


def same_loss(
    descriptors: Float32[Tensor, "M D"],
    line_ids: Int64[Tensor, "M"],
    means: LineMeans,
    margin: float,
) -> Float32[Tensor, ""]:
    """Pull the points of a line to its mean: ``mean_i mean_j [|mu_i - d_j|_1 - delta_s]_+^2``."""
    on_line = line_ids >= 0
    rows = means.row_of[line_ids[on_line]]
    counts = torch.bincount(rows, minlength=len(means.mu))
    gap = (means.mu[rows] - descriptors[on_line]).abs().sum(dim=1)
    pull = (gap - margin).clamp(min=0.0).square() / counts[rows]
    return pull.sum() / max(len(means.mu), 1)


def differ_loss(mu: Float32[Tensor, "L D"], margin: float) -> Float32[Tensor, ""]:
    """Push the lines of a scan apart: mean over pairs ``[2 delta_d - |mu_a - mu_b|_1]_+^2``."""
    first, second = torch.triu_indices(len(mu), len(mu), offset=1)
    return _push(mu[first], mu[second], margin)


def match_loss(
    mu: Float32[Tensor, "A D"],
    other: Float32[Tensor, "B D"],
    matches: Int64[Tensor, "K 2"],
    margin: float,
) -> Float32[Tensor, ""]:
    """Pull the same line of two scans together: ``mean_i [|mu_i - mu'_i|_1 - delta_s]_+^2``."""
    gap = (mu[matches[:, 0]] - other[matches[:, 1]]).abs().sum(dim=1)
    return (gap - margin).clamp(min=0.0).square().sum() / max(len(matches), 1)


def mismatch_loss(
    mu: Float32[Tensor, "A D"],
    other: Float32[Tensor, "B D"],
    matches: Int64[Tensor, "K 2"],
    margin: float,
) -> Float32[Tensor, ""]:
    """Push lines of two scans apart that are not the same: the mean over all such pairs."""
    foreign = torch.ones(len(mu), len(other), dtype=torch.bool)
    foreign[matches[:, 0], matches[:, 1]] = False
    first, second = foreign.nonzero(as_tuple=True)
    return _push(mu[first], other[second], margin)


def _push(first: Tensor, second: Tensor, margin: float) -> Tensor:
    gap = (first - second).abs().sum(dim=1)
    return (margin - gap).clamp(min=0.0).square().sum() / max(len(gap), 1)


def contrast_loss(
    mu: Float32[Tensor, "A D"],
    other: Float32[Tensor, "B D"],
    matches: Int64[Tensor, "K 2"],
    temperature: float,
) -> Float32[Tensor, ""]:
    """Rank the true partner first among all lines of the other scan, both ways.

    The cross-entropy of cosines over the temperature (van den Oord et al., 2018): what matching
    by mean descriptor asks for. Not of the paper.
    """
    if len(matches) == 0:
        return mu.sum() * 0.0
    unit, other_unit = (torch.nn.functional.normalize(rows, dim=1) for rows in (mu, other))
    scores = unit @ other_unit.T / temperature
    rows, columns = matches.T
    forth = cross_entropy(scores[rows], columns)
    back = cross_entropy(scores.T[columns], rows)
    return 0.5 * (forth + back)

"""All terms of the joint loss for one pair of scans."""

import torch
from torch import Tensor

from sl3d_slam.learning.batch import PairBatch
from sl3d_slam.learning.joint_settings import LossSettings
from sl3d_slam.learning.losses import (
    LineMeans,
    contrast_loss,
    differ_loss,
    line_means,
    match_loss,
    mismatch_loss,
    same_loss,
    segmentation_loss,
)
from sl3d_slam.lines.network.model import SuperLine3D

TERMS = ("segmentation", "same", "differ", "match", "mismatch", "contrast")


def pair_losses(model: SuperLine3D, batch: PairBatch, settings: LossSettings) -> dict[str, Tensor]:
    """Return the terms, each as a plain number with gradient, before they are weighted.

    Descriptors are computed where they count: on the points of lines.
    """
    encoded = model.encode(batch.points, batch.neighbours, batch.sizes)
    clouds = list(
        zip(torch.split(encoded, list(batch.sizes)), batch.line_ids, batch.kinds, strict=True)
    )
    found = [segmentation_loss(model.segmentation(e), ids, k, settings) for e, ids, k in clouds]
    ids = [ids[ids >= 0] for _, ids, _ in clouds]
    described = [model.describe(encoded[ids >= 0]) for encoded, ids, _ in clouds]
    means = [line_means(described[c], ids[c], len(batch.kinds[c])) for c in (0, 1)]
    same = [same_loss(described[c], ids[c], means[c], settings.same_margin) for c in (0, 1)]
    differ = [differ_loss(mean.mu, settings.differ_margin) for mean in means]
    return {
        "segmentation": 0.5 * (found[0] + found[1]),
        "same": 0.5 * (same[0] + same[1]),
        "differ": 0.5 * (differ[0] + differ[1]),
        **_between(means, batch, settings),
    }


def _between(means: list[LineMeans], batch: PairBatch, settings: LossSettings) -> dict[str, Tensor]:
    """Return the terms between the two clouds; a match needs points on both of its lines."""
    rows = [mean.row_of[batch.matches[:, k]] for k, mean in enumerate(means)]
    matches = torch.stack(rows, dim=1)
    matches = matches[(matches >= 0).all(dim=1)]
    mu, other = means[0].mu, means[1].mu
    return {
        "match": match_loss(mu, other, matches, settings.same_margin),
        "mismatch": mismatch_loss(mu, other, matches, settings.differ_margin),
        "contrast": contrast_loss(mu, other, matches, settings.temperature),
    }


def total_loss(terms: dict[str, Tensor], settings: LossSettings) -> Tensor:
    """Return ``omega L_seg + L_same + L_diff + L_match + L_mismatch + contrast``."""
    paper = terms["same"] + terms["differ"] + terms["match"] + terms["mismatch"]
    weighted = settings.segmentation * terms["segmentation"] + settings.discriminative * paper
    return weighted + settings.contrast * terms["contrast"]

"""The joint losses against values worked out by hand and the defects of the authors' code."""

import math

import numpy as np
import pytest
import torch

from sl3d_slam.learning.joint_settings import LossSettings
from sl3d_slam.learning.losses import (
    contrast_loss,
    differ_loss,
    line_means,
    match_loss,
    mismatch_loss,
    same_loss,
    segmentation_loss,
)
from sl3d_slam.types import LineKind

SETTINGS = LossSettings()
POLE, EDGE = int(LineKind.POLE), int(LineKind.VERTICAL_EDGE)


def ids(*values):
    return torch.tensor(values)


def test_margins_are_the_papers():
    assert SETTINGS.segmentation == 2.0
    assert SETTINGS.same_margin == 0.2
    assert SETTINGS.differ_margin == 2.0


def test_same_loss_by_hand():
    # line 0: points at 0 and 1 on one axis, mean 0.5, each 0.5 off: (0.5 - 0.2)^2 = 0.09
    # line 1: one point, on its own mean: 0
    descriptors = torch.tensor([[0.0, 0.0], [1.0, 0.0], [5.0, 5.0], [9.0, 9.0]])
    line_ids = ids(0, 0, 1, -1)
    means = line_means(descriptors, line_ids, 2)
    assert same_loss(descriptors, line_ids, means, 0.2).item() == pytest.approx(0.045, abs=1e-6)


def test_differ_loss_by_hand():
    # L1 gaps: 1, 3, 2 -> pushes (2 - 1)^2 = 1, 0, 0 over three pairs
    mu = torch.tensor([[0.0, 0.0], [0.5, 0.5], [1.5, 1.5]])
    assert differ_loss(mu, 2.0).item() == pytest.approx(1.0 / 3.0, abs=1e-6)


def test_match_and_mismatch_by_hand():
    mu = torch.tensor([[0.0, 0.0], [4.0, 0.0]])
    other = torch.tensor([[4.0, 0.5], [0.0, 0.2], [9.0, 9.0]])
    matches = ids((0, 1), (1, 0))
    # matched gaps 0.2 and 0.5: 0 and 0.3^2, mean 0.045; foreign gaps are all above 2
    assert match_loss(mu, other, matches, 0.2).item() == pytest.approx(0.045, abs=1e-6)
    assert mismatch_loss(mu, other, matches, 2.0).item() == 0.0
    # swapped, both pairs are foreign and close: ((2 - 0.5)^2 + (2 - 0.2)^2) / 4
    swapped = ids((0, 0), (1, 1))
    expected = (1.5**2 + 1.8**2) / 4
    assert mismatch_loss(mu, other, swapped, 2.0).item() == pytest.approx(expected, abs=1e-6)


def test_contrast_of_equal_scores_is_the_log_of_the_candidates():
    mu, other = torch.ones(2, 3), torch.ones(5, 3)
    loss = contrast_loss(mu, other, ids((0, 4), (1, 2)), 0.07)
    assert loss.item() == pytest.approx(0.5 * (math.log(5) + math.log(2)), abs=1e-5)


def test_contrast_falls_as_the_partner_comes_nearer():
    mu = torch.tensor([[1.0, 0.0]])
    near, far = torch.tensor([[0.9, 0.1], [0.0, 1.0]]), torch.tensor([[0.1, 0.9], [0.0, 1.0]])
    matches = ids((0, 0))
    assert contrast_loss(mu, near, matches, 0.1) < contrast_loss(mu, far, matches, 0.1)


def test_no_line_is_dropped_by_a_mask(rng):
    """The authors' mask was one element short: the last line never counted."""
    descriptors = torch.from_numpy(rng.normal(size=(12, 4)).astype(np.float32))
    line_ids = torch.arange(12) // 3
    means = line_means(descriptors, line_ids, 4)
    expected = descriptors.numpy().reshape(4, 3, 4).mean(axis=1)
    np.testing.assert_allclose(means.mu.numpy(), expected, atol=1e-6)
    assert means.row_of.tolist() == [0, 1, 2, 3]
    for line in range(4):
        moved = descriptors.clone()
        moved[3 * line] += 1.0
        again = line_means(moved, line_ids, 4)
        assert same_loss(moved, line_ids, again, 0.2) != same_loss(
            descriptors, line_ids, means, 0.2
        )


def test_a_line_without_points_leaves_the_others_in_place():
    means = line_means(torch.eye(3), ids(2, 0, -2), 3)
    assert means.row_of.tolist() == [0, -1, 1]
    assert means.mu.tolist() == [[0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]


def test_poles_and_edges_both_count(rng):
    """Two points of a pole have as much say as twenty of an edge; the authors' poles had none."""
    line_ids = ids(*[0] * 2, *[1] * 20, *[-1] * 60)
    kinds = ids(POLE, EDGE)
    logits = torch.zeros(82, 2, requires_grad=True)
    segmentation_loss(logits, line_ids, kinds, SETTINGS).backward()
    pull = logits.grad[:, 1]
    assert (pull[:22] < 0).all()
    assert (pull[22:] > 0).all()
    assert pull[:2].sum().item() == pytest.approx(pull[2:22].sum().item(), rel=1e-5)


def test_each_kind_of_line_that_occurs_has_the_same_part():
    line_ids = ids(*[0] * 3, *[1] * 7, *[2] * 5, *[-1] * 15)
    kinds = ids(POLE, EDGE, int(LineKind.UNKNOWN))
    logits = torch.zeros(30, 2, requires_grad=True)
    segmentation_loss(logits, line_ids, kinds, SETTINGS).backward()
    parts = [-logits.grad[line_ids == line, 1].sum().item() for line in range(3)]
    assert parts == pytest.approx([0.5 * 0.4 / 3] * 3, rel=1e-5)  # half a unit a point at p = 0.5
    background = logits.grad[line_ids == -1, 1].sum().item()
    assert background == pytest.approx(0.5 * 0.6, rel=1e-5)


def test_unknown_points_do_not_count():
    logits = torch.zeros(3, 2, requires_grad=True)
    segmentation_loss(logits, ids(0, -1, -2), ids(POLE), SETTINGS).backward()
    assert logits.grad[2].tolist() == [0.0, 0.0]
    assert logits.grad[:2].abs().sum() > 0


def test_scans_without_lines_or_matches_have_finite_losses():
    descriptors = torch.rand(5, 4, requires_grad=True)
    nothing = torch.full((5,), -1)
    means = line_means(descriptors, nothing, 0)
    no_matches = torch.zeros((0, 2), dtype=torch.long)
    total = (
        same_loss(descriptors, nothing, means, 0.2)
        + differ_loss(means.mu, 2.0)
        + match_loss(means.mu, means.mu, no_matches, 0.2)
        + mismatch_loss(means.mu, means.mu, no_matches, 2.0)
        + contrast_loss(means.mu, means.mu, no_matches, 0.1)
    )
    assert total.item() == 0.0
    logits = torch.zeros(5, 2)
    assert torch.isfinite(segmentation_loss(logits, nothing, torch.zeros(0).long(), SETTINGS))

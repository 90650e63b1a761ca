"""Line probabilities that can be read as odds, fitted after training; which point leads stays."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float64
from torch import nn

from sl3d_slam.errors import InputError
from sl3d_slam.learning.joint_validation import look_at
from sl3d_slam.learning.prepared import BACKGROUND, PreparedDrive
from sl3d_slam.lines.network.model import SuperLine3D

EVERY = 5
BINS = 10
MAX_ODDS = 1e6


class Calibration(NamedTuple):
    """Odds of the network ``z`` become ``slope z + shift``; errors are mean gaps to the truth.

    ``error_before`` and ``error_after`` are the expected calibration error (Guo et al., ICML 2017)
    over ten bins: how far, on average, a probability is from the share that is true.
    """

    slope: float
    shift: float
    error_before: float
    error_after: float


def calibrate(model: SuperLine3D, drives: Sequence[PreparedDrive]) -> Calibration:
    """Fit slope and shift of the line odds to labelled drives and build them into the last layer.

    Training weighs the kinds of points evenly, so that its probabilities are too high where lines
    are rare (Platt, 1999, is the fit). Drives that were not trained on give honest ones.

    Raises
    ------
    InputError
        where the drives hold no point on a line, or none beside, or the network believes less in
        what is on lines than in what is not.
    """
    logits, truth = _judged(model, drives)
    if truth.all() or not truth.any():
        names = ", ".join(drive.name for drive in drives)
        raise InputError(f"{names}: expected points on lines and points beside them")
    slope, shift = fit_odds(logits, truth)
    if slope <= 0:
        raise InputError(f"{drives[0].name}: the network is less sure where its lines are")
    last = model.segmentation[-1]
    assert isinstance(last, nn.Linear)
    with torch.no_grad():
        last.weight.mul_(slope)
        last.bias.mul_(slope)
        last.bias.add_(torch.tensor([-0.5 * shift, 0.5 * shift]))
    before, after = probability_of(logits), probability_of(slope * logits + shift)
    return Calibration(
        slope, shift, calibration_error(before, truth), calibration_error(after, truth)
    )


def _judged(
    model: SuperLine3D, drives: Sequence[PreparedDrive]
) -> tuple[Float64[np.ndarray, "N"], Bool[np.ndarray, "N"]]:
    """Return the log odds that a network gives points whose truth is known, and that truth."""
    odds, truth = [np.zeros(0)], [np.zeros(0, bool)]
    for drive in drives:
        for scan in drive.scans[::EVERY]:
            known = scan.line_ids >= BACKGROUND
            probability = look_at(model, scan).line_probability[known].astype(np.float64)
            odds.append(log_odds(probability))
            truth.append(scan.line_ids[known] >= 0)
    return np.concatenate(odds), np.concatenate(truth)


def log_odds(probability: Float64[np.ndarray, "N"]) -> Float64[np.ndarray, "N"]:
    """Return the log odds of probabilities, certain ones as a million to one."""
    odds = probability / np.maximum(1.0 - probability, 1e-12)
    return np.asarray(np.log(np.clip(odds, 1.0 / MAX_ODDS, MAX_ODDS)))


def probability_of(logits: Float64[np.ndarray, "N"]) -> Float64[np.ndarray, "N"]:
    """Return the probabilities of log odds."""
    return np.asarray(1.0 / (1.0 + np.exp(-logits)))


def fit_odds(
    logits: Float64[np.ndarray, "N"], truth: Bool[np.ndarray, "N"], rounds: int = 50
) -> tuple[float, float]:
    """Return the slope and the shift that make the truth most likely (Newton's method)."""
    columns = np.stack([logits, np.ones(len(logits))], axis=1)
    fit = np.array([1.0, 0.0])
    for _ in range(rounds):
        p = probability_of(columns @ fit)
        curvature = (columns * (p * (1.0 - p))[:, None]).T @ columns + 1e-6 * np.eye(2)
        step = np.linalg.solve(curvature, columns.T @ (truth - p))
        fit = fit + step / max(1.0, float(np.abs(step).max()))
        if np.abs(step).max() < 1e-9:
            break
    return float(fit[0]), float(fit[1])


def calibration_error(probability: Float64[np.ndarray, "N"], truth: Bool[np.ndarray, "N"]) -> float:
    """Return the mean gap between probability and truth over ten bins, by points in them."""
    bins = np.minimum((probability * BINS).astype(int), BINS - 1)
    gaps = np.bincount(bins, probability - truth, BINS)
    return float(np.abs(gaps).sum() / len(truth))

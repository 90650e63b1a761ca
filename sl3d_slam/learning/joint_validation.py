"""How well a network finds and tells apart the lines of drives that it was not trained on."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float32, Float64, Int64

from sl3d_slam.geometry.se3 import invert
from sl3d_slam.learning.pairs import close_pairs, same_lines
from sl3d_slam.learning.prepared import BACKGROUND, PreparedDrive, PreparedScan
from sl3d_slam.lines.network.model import LINE, SuperLine3D
from sl3d_slam.lines.network.neighbours import skip_neighbours

DISTANCES_M = (10.0, 20.0, 30.0)
TOLERANCE_M = 1.5
MATCH_M = 0.3
MIN_MEMBERS = 3


@dataclass(frozen=True, slots=True)
class Ranking:
    """Where true partners rank at one distance: shares of ``num_lines`` and chance's share."""

    distance_m: float
    num_pairs: int
    num_lines: int
    first: float
    top_five: float
    chance_five: float


@dataclass(frozen=True, slots=True)
class Detection:
    """Points of lines found: at p > 0.5, the best F1 of any threshold, and its threshold."""

    precision: float
    recall: float
    best_f1: float
    best_threshold: float


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """What a network makes of a scan: probability per point, mean descriptor per labelled line."""

    line_probability: Float32[np.ndarray, "M"]
    line_rows: Int64[np.ndarray, "K"]
    descriptors: Float32[np.ndarray, "K D"]


def look_at(model: SuperLine3D, scan: PreparedScan) -> Seen:
    """Run the network over a scan; lines with fewer than three points are left out."""
    settings = model.settings
    neighbours = skip_neighbours(scan.points, settings.num_neighbours, settings.stride)
    with torch.no_grad():
        logits, described = model.eval()(
            torch.from_numpy(scan.points), torch.from_numpy(neighbours)
        )
        probability = logits.softmax(dim=1)[:, LINE].numpy()
    counts = np.bincount(scan.line_ids[scan.line_ids >= 0], minlength=len(scan.endpoints))
    rows = np.flatnonzero(counts >= MIN_MEMBERS)
    means = [described.numpy()[scan.line_ids == row].mean(axis=0) for row in rows]
    table = np.array(means, np.float32).reshape(-1, described.shape[1])
    norms = np.linalg.norm(table, axis=1, keepdims=True)
    return Seen(probability, rows, table / np.maximum(norms, 1e-9))


def pairs_at(
    T_world_lidar: Float64[np.ndarray, "N 4 4"], distance_m: float, count: int, seed: int
) -> list[tuple[int, int]]:
    """Draw pairs of scans whose distance is within 1.5 m of the wanted one."""
    pairs = close_pairs(T_world_lidar, distance_m + TOLERANCE_M)
    steps = np.diff(T_world_lidar[pairs, :3, 3], axis=1)[:, 0]
    pairs = pairs[np.linalg.norm(steps, axis=1) >= distance_m - TOLERANCE_M]
    rng = np.random.default_rng([seed, int(distance_m)])
    chosen = rng.permutation(len(pairs))[:count]
    return [(int(i), int(j)) for i, j in pairs[chosen]]


def rank(
    model: SuperLine3D, drive: PreparedDrive, pairs_per_distance: int = 30, seed: int = 0
) -> list[Ranking]:
    """Rank, for each line seen from both places, its partner among all lines of the other scan."""
    seen: dict[int, Seen] = {}
    rankings = []
    for distance_m in DISTANCES_M:
        pairs = pairs_at(drive.T_world_lidar, distance_m, pairs_per_distance, seed)
        ranks, chances = [], []
        for i, j in pairs:
            for k in {i, j} - seen.keys():
                seen[k] = look_at(model, drive.scans[k])
            found = _ranks(drive, (i, j), seen[i], seen[j])
            ranks.append(found)
            chances.append(np.full(len(found), min(1.0, 5.0 / max(len(seen[j].line_rows), 1))))
        rankings.append(_summary(distance_m, ranks, chances))
    return rankings


def _ranks(
    drive: PreparedDrive, pair: tuple[int, int], target: Seen, source: Seen
) -> Int64[np.ndarray, "K"]:
    """Return the rank (from 0) of the partner of each line of the first scan that has one."""
    i, j = pair
    T_i_j = invert(drive.T_world_lidar[i]) @ drive.T_world_lidar[j]
    matches = same_lines(
        drive.scans[i].endpoints[target.line_rows],
        drive.scans[j].endpoints[source.line_rows],
        T_i_j,
        MATCH_M,
    )
    scores = target.descriptors @ source.descriptors.T
    partner = scores[matches[:, 0], matches[:, 1]]
    return (scores[matches[:, 0]] > partner[:, None]).sum(axis=1)


def _summary(
    distance_m: float, ranks: Sequence[np.ndarray], chances: Sequence[np.ndarray]
) -> Ranking:
    rank_of = np.concatenate([np.zeros(0, np.int64), *ranks])
    chance = np.concatenate([np.zeros(0), *chances])
    if len(rank_of) == 0:
        return Ranking(distance_m, len(ranks), 0, 0.0, 0.0, 0.0)
    return Ranking(
        distance_m,
        len(ranks),
        len(rank_of),
        float(np.mean(rank_of == 0)),
        float(np.mean(rank_of < 5)),
        float(chance.mean()),
    )


def detect(model: SuperLine3D, drive: PreparedDrive, every: int = 5) -> Detection:
    """Compare the points found with the labelled ones over every fifth scan; unknown ones apart."""
    scans = drive.scans[::every]
    probability = np.concatenate([look_at(model, scan).line_probability for scan in scans])
    ids = np.concatenate([scan.line_ids for scan in scans])
    known = ids >= BACKGROUND
    probability, truth = probability[known], ids[known] >= 0
    order = np.argsort(-probability, kind="stable")
    hits = np.cumsum(truth[order])
    precision = hits / np.arange(1, len(hits) + 1)
    recall = hits / max(int(truth.sum()), 1)
    f1 = 2 * precision * recall / np.maximum(precision + recall, 1e-9)
    best = int(f1.argmax())
    at_half = int((probability > 0.5).sum()) - 1
    return Detection(
        float(precision[at_half]) if at_half >= 0 else 0.0,
        float(recall[at_half]) if at_half >= 0 else 0.0,
        float(f1[best]),
        float(probability[order][best]),
    )

"""Planar poses that lines suggest: which differ, which fields like, which have lines alike."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float64

from sl3d_slam.config import MatchingSettings
from sl3d_slam.matching import field
from sl3d_slam.matching.consistency import PlanarPoses, enumerate_poses, thin_poses
from sl3d_slam.matching.judge import lines_under, standing_out
from sl3d_slam.matching.prepared import PreparedView

NUM_REFINED, NUM_ALIKE = 3, 5  # poses that fields and lines like best, whose lines are most alike
NUM_COMPARED = 40
NUM_JUDGED_FULLY = 400  # poses that every point of the fields judges; the others a quarter of them
THINNING = 4
LINE_VOTE = 0.05  # what one agreeing line adds to the mean field value
ALIKE_VOTE = 0.5  # what a unit of log likeness adds to it
DISTINCT_M = 2.0
DISTINCT_RAD = np.radians(8.0)


def line_poses(
    source: PreparedView, target: PreparedView, settings: MatchingSettings
) -> tuple[PlanarPoses, np.ndarray]:
    """Return the planar poses that lines alone like best, with their line scores, best first."""
    poses, scores = enumerate_poses(
        source.verticals,
        target.verticals,
        settings.distance_tolerance_m,
        settings.inlier_distance_m,
    )
    return thin_poses(poses, scores, settings.max_hypotheses)


def distinct(poses: PlanarPoses, limit: int) -> np.ndarray:
    """Return indices of the first poses that differ from all chosen before them."""
    chosen: list[int] = []
    for k in range(len(poses)):
        shift = np.hypot(*(poses[chosen, 1:] - poses[k, 1:]).T)
        turn = np.abs(np.angle(np.exp(1j * (poses[chosen, 0] - poses[k, 0]))))
        if np.all((shift > DISTINCT_M) | (turn > DISTINCT_RAD)):
            chosen.append(k)
            if len(chosen) == limit:
                break
    return np.array(chosen, np.int64)


def by_fields(
    source: PreparedView, target: PreparedView, poses: PlanarPoses, line_scores: np.ndarray
) -> tuple[Float64[np.ndarray, "K 3"], np.ndarray]:
    """Return the best of planar poses (yaw, x, y) of levelled frames, best first, and their scores.

    The score is how well the fields agree plus a little for every line.
    """
    thin = (_thinned(source.field), _thinned(target.field))
    rough = _both_ways(*thin, poses) + LINE_VOTE * line_scores
    kept = np.sort(np.argsort(-rough, kind="stable")[:NUM_JUDGED_FULLY])
    poses = poses[kept]
    scores = field_agreement(source, target, poses) + LINE_VOTE * line_scores[kept]
    order = np.argsort(-scores, kind="stable")
    return poses[order], scores[order]


def field_agreement(source: PreparedView, target: PreparedView, poses: PlanarPoses) -> np.ndarray:
    """Return the fields' mean values under each pose, both ways added: in [-1.2, 2]."""
    return _both_ways(source.field, target.field, poses)


def _both_ways(
    source: field.StructureField, target: field.StructureField, poses: PlanarPoses
) -> np.ndarray:
    forward = field.score_poses(source, target, poses)
    return forward + field.score_poses(target, source, field.invert_poses(poses))


def _thinned(whole: field.StructureField) -> field.StructureField:
    return field.StructureField(whole.value, whole.points[::THINNING])


def likeliest(poses: PlanarPoses, scores: np.ndarray) -> Iterator[tuple[np.ndarray, float]]:
    """Yield the best poses that differ from each other, and by how much each leads the others."""
    chosen = distinct(poses, NUM_REFINED)
    for k in chosen:
        rivals = [scores[j] for j in chosen if j != k]
        yield poses[k], float(scores[k] - max(rivals)) if rivals else float(scores[k])


def most_alike(
    source: PreparedView,
    target: PreparedView,
    poses: tuple[PlanarPoses, Float64[np.ndarray, "L 3"]],
    settings: MatchingSettings,
) -> Iterator[tuple[np.ndarray, float]]:
    """Yield further poses, those first whose lines are alike, and what they lack in the fields.

    From those that the fields and those that lines like, best first.
    """
    compared = [some[distinct(some, NUM_COMPARED)] for some in poses]
    num_tried = min(NUM_REFINED, len(compared[0]))
    some = np.concatenate(compared)
    some = some[distinct(some, len(some))]  # those that were tried come first
    best, others = some[:1], some[num_tried:]
    lacking = field_agreement(source, target, others) - field_agreement(source, target, best)
    pairs = standing_out(source.view.lines, target.view.lines)
    reach_m = settings.inlier_distance_m
    matches = [lines_under(source, target, pose, reach_m) for pose in others]
    alike = np.array([pairs[rows[:, 0], rows[:, 1]].sum() for rows in matches], np.float64)
    for k in np.argsort(-(lacking + ALIKE_VOTE * np.log1p(alike)), kind="stable")[:NUM_ALIKE]:
        yield others[k], float(lacking[k])

"""Where is one scan in the frame of another? No first guess, no sampling, a reasoned no.

Standing lines propose every pose, a bird's-eye field of the coarse clouds judges the best few
thousand, GICP refines the few that are left, and what each scan saw through decides.
"""

from dataclasses import replace

import numpy as np

from sl3d_slam.config import MatchingSettings
from sl3d_slam.errors import InputError
from sl3d_slam.geometry.se3 import Points
from sl3d_slam.matching import field
from sl3d_slam.matching.consistency import (
    PlanarPoses,
    enumerate_poses,
    match_verticals,
    thin_poses,
)
from sl3d_slam.matching.judge import (
    Evidence,
    matched_lines,
    objection,
    refusal,
    to_registration,
    weigh,
)
from sl3d_slam.matching.prepared import PreparedView, lift
from sl3d_slam.matching.refine import align_near, fit_planar
from sl3d_slam.matching.solve import (
    fill_free,
    line_distances_m,
    line_information,
    refine_on_lines,
)
from sl3d_slam.matching.verticals import up_of_lines
from sl3d_slam.matching.views import make_view, view_of_lines
from sl3d_slam.types import LineSet, Registration

DISTINCT_M = 2.0
DISTINCT_RAD = np.radians(8.0)
NUM_REFINED = 3
LINE_VOTE = 0.05  # what one agreeing line adds to the mean field value
MIN_LINES_LOG_ODDS = 1.0  # where lines decide alone


def register_lines(
    source: LineSet,
    target: LineSet,
    clouds: tuple[np.ndarray, np.ndarray] | None = None,
    settings: MatchingSettings | None = None,
) -> Registration:
    """Find ``T_target_source`` from the lines of two scans, with no first guess.

    Parameters
    ----------
    source, target : lines of each scan in its lidar frame (x forward, y left, z up; up to 25
        degrees of tilt).
    clouds : (source_points, target_points), each (N, 3) metres in the same lidar frames: poses are
        then verified and refined densely. Without them the lines decide alone; parallel poles leave
        the height free, and far or short ones roll and pitch too: the information shows it.
    settings : tolerances; defaults where None.

    Returns
    -------
    Registration, whose ``information`` is in GTSAM's order (rotation first) at the source frame;
    ``success=False`` carries a reason and no pose.

    Raises
    ------
    InputError
        where a cloud is no (N, 3) of finite numbers.
    """
    settings = settings or MatchingSettings()
    if clouds is None:
        views = [view_of_lines(lines, up_of_lines(lines)) for lines in (source, target)]
        prepared = [PreparedView(view, settings) for view in views]
        return _register_lines_alone(prepared[0], prepared[1], settings)
    checked = [
        _checked_cloud(cloud, name)
        for cloud, name in zip(clouds, ("source", "target"), strict=True)
    ]
    views = [
        make_view(cloud, lines, settings.cloud_voxel_m)
        for cloud, lines in zip(checked, (source, target), strict=True)
    ]
    return register_views(
        PreparedView(views[0], settings), PreparedView(views[1], settings), settings
    )


def register_views(
    source: PreparedView, target: PreparedView, settings: MatchingSettings
) -> Registration:
    """Find ``T_target_source`` of two views with clouds."""
    poses, scores = planar_seeds(source, target, settings)
    if len(poses) == 0:
        return refusal("no two standing lines of one scan fit two of the other")
    chosen = distinct(poses, NUM_REFINED)
    best: Evidence | None = None
    for k in chosen:
        rivals = [scores[j] for j in chosen if j != k]
        lead = float(scores[k] - max(rivals)) if rivals else float(scores[k])
        evidence = _evidence(source, target, poses[k], lead, settings)
        if evidence is None:
            return refusal("a cloud has too few points to verify a pose with")
        if not objection(evidence, settings):
            return to_registration(evidence, "")
        if best is None or evidence.log_odds > best.log_odds:
            best = evidence
    assert best is not None
    return to_registration(best, objection(best, settings))


def _evidence(
    source: PreparedView,
    target: PreparedView,
    pose: np.ndarray,
    lead: float,
    settings: MatchingSettings,
) -> Evidence | None:
    """Refine a planar pose by all its lines, then by the clouds, and weigh it."""
    if source.dense is None or target.dense is None:
        return None
    on_lines = fit_planar(source.verticals, target.verticals, pose, settings.inlier_distance_m)
    T_guess = lift(source, target, on_lines)
    aligned = align_near(target.dense, source.dense, T_guess)
    evidence = weigh(source, target, T_guess, aligned, settings)
    lines = source.view.lines, target.view.lines
    T = evidence.T_target_source
    by_lines = line_information(*lines, evidence.matches, T)
    return replace(evidence, lead=lead, information=fill_free(evidence.information, by_lines))


def planar_seeds(
    source: PreparedView, target: PreparedView, settings: MatchingSettings
) -> tuple[PlanarPoses, np.ndarray]:
    """Return planar poses (yaw, x, y) of levelled frames and their scores, best first.

    The score is how well the fields agree plus a little for every line.
    """
    poses, line_scores = _line_poses(source, target, settings)
    scores = field_agreement(source, target, poses) + LINE_VOTE * line_scores
    order = np.argsort(-scores, kind="stable")
    return poses[order], scores[order]


def _line_poses(
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


def field_agreement(source: PreparedView, target: PreparedView, poses: PlanarPoses) -> np.ndarray:
    """Return the fields' mean values under each pose, both ways added: in [-1.2, 2]."""
    forward = field.score_poses(source.field, target.field, poses)
    backward = field.score_poses(target.field, source.field, field.invert_poses(poses))
    return forward + backward


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


def _register_lines_alone(
    source: PreparedView, target: PreparedView, settings: MatchingSettings
) -> Registration:
    poses, scores = _line_poses(source, target, settings)
    chosen = distinct(poses, 2)
    if len(chosen) == 0:
        return refusal("no two standing lines of one scan fit two of the other")
    seed, reach_m = poses[chosen[0]], settings.inlier_distance_m
    agreeing = len(match_verticals(source.verticals, target.verticals, seed, reach_m))
    rival_share = float(scores[chosen[1]] / scores[chosen[0]]) if len(chosen) > 1 else 0.0
    on_lines = fit_planar(source.verticals, target.verticals, seed, reach_m)
    T_guess = lift(source, target, on_lines)
    lines = source.view.lines, target.view.lines
    matches = matched_lines(source, target, T_guess, reach_m)
    T, information = refine_on_lines(*lines, matches, T_guess)
    matches = matched_lines(source, target, T, reach_m)
    matches = matches[line_distances_m(*lines, matches, T) < reach_m]
    reason = ""
    if len(matches) < settings.min_inliers:
        reason = f"only {len(matches)} lines agree, {settings.min_inliers} are needed"
    elif lines_log_odds(agreeing, rival_share) < MIN_LINES_LOG_ODDS:
        reason = f"{agreeing} lines agree, but another place fits {rival_share:.0%} as well"
    return Registration(
        success=not reason,
        T_target_source=None if reason else T,
        num_inliers=len(matches),
        matches=matches,
        information=np.zeros((6, 6)) if reason else information,
        reason=reason,
    )


def lines_log_odds(agreeing: int, rival_share: float) -> float:
    """Return the log odds that the pose which lines alone like best is right.

    ``agreeing`` counts the lines it lays on each other, ``rival_share`` is the next place's share
    of its score. Logistic regression over single scans of drives 01 and 02 and two simulated towns,
    10 to 40 m apart or of different places; above 1 lie 95 % of the right ones and none of 103
    wrong.
    """
    return float(-12.2 + 9.5 * (1.0 - rival_share) + 5.0 * np.log1p(agreeing))


def _checked_cloud(cloud: np.ndarray, name: str) -> Points:
    points = np.asarray(cloud, np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"clouds: {name} has shape {points.shape}, expected (N, 3) in metres")
    if not np.isfinite(points).all():
        raise InputError(f"clouds: {name} holds NaN or infinite coordinates; drop those points")
    return points

"""A pose from lines alone, where there are no clouds to verify it with."""

import numpy as np

from sl3d_slam.config import MatchingSettings
from sl3d_slam.matching.consistency import match_verticals
from sl3d_slam.matching.judge import matched_lines, refusal
from sl3d_slam.matching.prepared import PreparedView, lift
from sl3d_slam.matching.refine import fit_planar
from sl3d_slam.matching.seeds import distinct, line_poses
from sl3d_slam.matching.solve import line_distances_m, refine_on_lines
from sl3d_slam.types import Registration

MIN_LOG_ODDS = 1.0


def register_alone(
    source: PreparedView, target: PreparedView, settings: MatchingSettings
) -> Registration:
    """Find ``T_target_source`` by the lines of two views; a direction they leave free is shown."""
    poses, scores = line_poses(source, target, settings)
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
    elif lines_log_odds(agreeing, rival_share) < MIN_LOG_ODDS:
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

"""Where is one scan in the frame of another? No first guess, no sampling, a reasoned no.

Standing lines propose every pose, a bird's-eye field of the coarse clouds judges the best few
thousand, GICP refines the few that are left, and what each scan saw through decides, with the lines
that agree. Where that finds none, poses whose lines are more alike are tried.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float64

from sl3d_slam.config import MatchingSettings
from sl3d_slam.errors import InputError
from sl3d_slam.geometry.se3 import Points
from sl3d_slam.matching.alone import register_alone
from sl3d_slam.matching.judge import (
    Evidence,
    gather_near,
    objection,
    refusal,
    to_registration,
)
from sl3d_slam.matching.prepared import PreparedView, lift
from sl3d_slam.matching.refine import fit_planar
from sl3d_slam.matching.seeds import by_fields, likeliest, line_poses, most_alike
from sl3d_slam.matching.verticals import up_of_lines
from sl3d_slam.matching.views import make_view, view_of_lines
from sl3d_slam.side_by_side import side_by_side
from sl3d_slam.types import LineSet, Registration


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
        return register_alone(prepared[0], prepared[1], settings)
    checked = [
        _checked_cloud(cloud, name)
        for cloud, name in zip(clouds, ("source", "target"), strict=True)
    ]
    sides = prepare_views((source, target), (checked[0], checked[1]), settings)
    return register_views(*sides, settings)


def prepare_views(
    lines: tuple[LineSet, LineSet],
    clouds: tuple[Points, Float64[np.ndarray, "M 3"]],
    settings: MatchingSettings,
) -> tuple[PreparedView, PreparedView]:
    """Make ready the source and the target of a registration, both at once."""

    def prepare(side: int) -> PreparedView:
        view = make_view(clouds[side], lines[side], settings.cloud_voxel_m)
        return PreparedView(view, settings).prepare(moves=side == 0)

    return side_by_side(prepare, 0, 1)


def register_views(
    source: PreparedView,
    target: PreparedView,
    settings: MatchingSettings,
    thorough: bool = True,
) -> Registration:
    """Find ``T_target_source`` of two views with clouds.

    The poses that fields and lines together like best are tried first, then, if ``thorough``, those
    whose lines are most alike: around a corner two scans share little, and fields then like a wrong
    place better.
    """
    by_lines, line_scores = line_poses(source, target, settings)
    poses, scores = by_fields(source, target, by_lines, line_scores)
    best: Evidence | None = None
    for pose, lead in likeliest(poses, scores):
        evidence = _evidence(source, target, pose, lead, settings)
        if evidence is None:
            return refusal("a cloud has too few points to verify a pose with")
        if not objection(evidence, settings):
            return to_registration(evidence, "")
        if best is None or evidence.log_odds > best.log_odds:
            best = evidence
    if best is None:
        return refusal("no two standing lines of one scan fit two of the other")
    for pose, lead in most_alike(source, target, (poses, by_lines), settings) if thorough else ():
        evidence = _evidence(source, target, pose, lead, settings)
        if evidence is not None and not objection(evidence, settings):
            return to_registration(evidence, "")
    return to_registration(best, objection(best, settings))


def _evidence(
    source: PreparedView,
    target: PreparedView,
    pose: np.ndarray,
    lead: float,
    settings: MatchingSettings,
) -> Evidence | None:
    """Refine a planar pose by all its lines, then by the clouds, and weigh it."""
    on_lines = fit_planar(source.verticals, target.verticals, pose, settings.inlier_distance_m)
    T_guess = lift(source, target, on_lines)
    evidence = gather_near(source, target, target.dense, T_guess, settings)
    return None if evidence is None else replace(evidence, lead=lead)


def _checked_cloud(cloud: np.ndarray, name: str) -> Points:
    points = np.asarray(cloud, np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"clouds: {name} has shape {points.shape}, expected (N, 3) in metres")
    if not np.isfinite(points).all():
        raise InputError(f"clouds: {name} holds NaN or infinite coordinates; drop those points")
    return points

"""Two sessions in one map: places of one looked up in the other, then all keyframes optimised."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64
from scipy.spatial import cKDTree

from sl3d_slam.config import GraphSettings, SlamConfig
from sl3d_slam.errors import InputError
from sl3d_slam.geometry.se3 import (
    Transform,
    adjoint,
    distance_m,
    invert,
    rotation_angle_rad,
)
from sl3d_slam.graph.noise import Matrix6, chain_covariance
from sl3d_slam.graph.solve import Edge, anchor, optimise
from sl3d_slam.mapping.join import join_maps
from sl3d_slam.mapping.line_map import LineMap
from sl3d_slam.mapping.places import Places
from sl3d_slam.relocalization.map_finder import MapFinder

MAX_ASKED = 200
MIN_TIES = 3
AGREE_M, AGREE_PER_M = 2.0, 0.03
AGREE_RAD = np.radians(6.0)
NEIGHBOUR_M = 15.0
METRES_A_SCAN = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class Tie:
    """A keyframe of the second map, seen from one of the first; information at the second's."""

    first: int
    second: int
    T_first_second: Transform
    information: Matrix6


@dataclass(frozen=True, slots=True, eq=False)
class Merged:
    """The joined map, or why there is none, and how it came about.

    Attributes
    ----------
    line_map : both sessions in the frame of the first, whose keyframes come first; or None.
    T_first_second : where the second map's frame lies in the first's, before optimising; or None.
    num_asked, num_found, num_agreeing : places of the second map that were looked up in the first,
        were found, and agree on where the second map lies.
    reason : empty on success, else one sentence.
    """

    line_map: LineMap | None
    T_first_second: Transform | None
    num_asked: int
    num_found: int
    num_agreeing: int
    reason: str = ""


def merge_maps(
    first: LineMap,
    second: LineMap,
    config: SlamConfig,
    progress: Callable[[], None] = lambda: None,
) -> Merged:
    """Join two maps of overlapping streets, in the frame of the first.

    Fewer than three places of the second map that are found in the first and agree are a no.

    Raises
    ------
    InputError
        where the maps are of different line models, or one has no landmarks or no cloud.
    """
    if first.model != second.model:
        raise InputError(
            f"a map of the line model {first.model} and one of {second.model} cannot be joined; "
            "expected two maps of one model"
        )
    asked = places_to_ask(second)
    ties = find_ties(first, second, asked, config, progress)
    T_first_map, agree = agreement(first, second, ties)
    if agree.sum() < MIN_TIES:
        reason = (
            f"{len(ties)} of {len(asked)} places of the second map were found in the first, "
            f"{int(agree.sum())} of them agree on where it lies; {MIN_TIES} are needed"
        )
        return Merged(None, None, len(asked), len(ties), int(agree.sum()), reason)
    kept = [tie for tie, agrees in zip(ties, agree, strict=True) if agrees]
    poses = optimised(first, second, kept, T_first_map, config.graph)
    count = len(first.T_map_keyframe)
    joined = join_maps(first.reposed(poses[:count]), second.reposed(poses[count:]), config.map)
    return Merged(joined, T_first_map, len(asked), len(ties), int(agree.sum()))


def places_to_ask(second: LineMap) -> list[int]:
    """Return keyframes of a map, evenly over all of them, at most 200."""
    count = len(second.T_map_keyframe)
    return list(range(0, count, max(1, -(-count // MAX_ASKED))))


def find_ties(
    first: LineMap,
    second: LineMap,
    asked: list[int],
    config: SlamConfig,
    progress: Callable[[], None],
) -> list[Tie]:
    """Look places of the second map up in the first."""
    finder, places = MapFinder(first, config), Places(second)
    ties = []
    for keyframe in asked:
        found = finder.find(places.view(keyframe))
        progress()
        T_first_place = found.relocalization.T_map_lidar
        if T_first_place is None:
            continue
        T_place_keyframe = invert(places.frame(keyframe)) @ second.T_map_keyframe[keyframe]
        T_map_seer = first.T_map_keyframe[found.keyframe]
        carry = adjoint(T_place_keyframe)
        ties.append(
            Tie(
                found.keyframe,
                keyframe,
                invert(T_map_seer) @ T_first_place @ T_place_keyframe,
                carry.T @ found.relocalization.information @ carry,
            )
        )
    return ties


def agreement(
    first: LineMap, second: LineMap, ties: list[Tie]
) -> tuple[Transform, Bool[np.ndarray, "T"]]:
    """Return ``T_first_second`` of the maps by the tie that most others agree with, and those.

    Sessions drift apart: the farther two ties lie from each other, the more they may differ.
    """
    best, agreeing = np.eye(4), np.zeros(len(ties), np.bool_)
    for tie in ties:
        T_first_map = (
            first.T_map_keyframe[tie.first]
            @ tie.T_first_second
            @ invert(second.T_map_keyframe[tie.second])
        )
        agrees = np.array([_agrees(T_first_map, first, second, one, tie) for one in ties])
        if agrees.sum() > agreeing.sum():
            best, agreeing = T_first_map, agrees
    return best, agreeing


def optimised(
    first: LineMap,
    second: LineMap,
    ties: list[Tie],
    T_first_map: Transform,
    settings: GraphSettings,
) -> Float64[np.ndarray, "K 4 4"]:
    """Return the poses of all keyframes, the second map's last, in the first's frame."""
    start = np.concatenate([first.T_map_keyframe, T_first_map @ second.T_map_keyframe])
    count = len(first.T_map_keyframe)
    edges = _skeleton(start[:count], 0, settings) + _skeleton(start[count:], count, settings)
    edges += [
        Edge(tie.first, count + tie.second, tie.T_first_second, tie.information) for tie in ties
    ]
    _, values = optimise(dict(enumerate(start)), edges, [anchor(0, start[0])])
    return np.array([values.atPose3(key).matrix() for key in range(len(start))])


def _agrees(T_first_map: Transform, first: LineMap, second: LineMap, one: Tie, by: Tie) -> bool:
    """Tell whether a tie lies where an alignment of the maps, taken from another, puts it."""
    T_expected = T_first_map @ second.T_map_keyframe[one.second]
    T_error = invert(T_expected) @ first.T_map_keyframe[one.first] @ one.T_first_second
    apart = second.T_map_keyframe[one.second, :3, 3] - second.T_map_keyframe[by.second, :3, 3]
    allowed_m = AGREE_M + AGREE_PER_M * float(np.linalg.norm(apart))
    return bool(distance_m(T_error) < allowed_m and rotation_angle_rad(T_error) < AGREE_RAD)


def _skeleton(
    poses: Float64[np.ndarray, "K 4 4"], offset: int, settings: GraphSettings
) -> list[Edge]:
    """Return what a map knows of its own shape: steps along the drive, and across where it met.

    A map file holds no loops; keyframes near each other in a finished map were held together by
    them, and are held here as if odometry led from one to the other.
    """
    pairs = [(k, k + 1) for k in range(len(poses) - 1)]
    near = cKDTree(poses[:, :3, 3]).query_pairs(NEIGHBOUR_M, output_type="ndarray")
    pairs += [(int(a), int(b)) for a, b in near if b - a > 1]
    edges = []
    for a, b in pairs:
        T_a_b = invert(poses[a]) @ poses[b]
        scans = max(1, min(100, round(distance_m(T_a_b) / METRES_A_SCAN)))
        information = np.linalg.inv(chain_covariance(T_a_b, scans, settings))
        edges.append(Edge(offset + a, offset + b, T_a_b, information))
    return edges

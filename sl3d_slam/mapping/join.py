"""Two maps in one frame become one."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float64, Int64
from scipy.spatial import cKDTree

from sl3d_slam.config import MapSettings
from sl3d_slam.errors import InputError
from sl3d_slam.mapping.build import (
    Observations,
    by_keyframe,
    group_observations,
    join_lines,
    keep_landmarks,
    trusted,
    unique_sightings,
)
from sl3d_slam.mapping.landmarks import mean_lines
from sl3d_slam.mapping.line_map import LineMap, landmark_up, seeing
from sl3d_slam.mapping.voxels import VoxelCloud, join_clouds


def join_maps(first: LineMap, second: LineMap, settings: MapSettings) -> LineMap:
    """Join two maps that are given in one frame; the second's keyframes come last.

    What the first saw and the second did not, although it passed, counts against a landmark as in
    a single drive.
    """
    if first.model != second.model:
        raise InputError(
            f"a map of the line model {first.model} and one of {second.model} cannot be joined; "
            "expected two maps of one model"
        )
    lines = join_lines([first.lines, second.lines])
    weights = np.concatenate([first.support, second.support]).astype(np.float64)
    up = np.concatenate([landmark_up(first), landmark_up(second)])
    groups = group_observations(Observations(lines, up, weights), settings)
    poses = np.concatenate([first.T_map_keyframe, second.T_map_keyframe])
    keyframes = np.concatenate([seeing(first), seeing(second) + len(first.keyframe_up)])
    rows = np.concatenate([first.indices, second.indices + len(first)])
    sightings = unique_sightings(groups[rows], keyframes)
    merged = mean_lines(lines, weights, groups)
    kept = trusted(merged, sightings, poses[:, :3, 3], settings)
    merged, sightings = keep_landmarks(merged, sightings, kept)
    offsets, indices = by_keyframe(sightings, len(poses))
    origin = replace(first.origin, simulated=first.simulated or second.simulated)
    up = np.concatenate([first.keyframe_up, second.keyframe_up])
    return LineMap(merged, poses, up, offsets, indices, _joined_cloud(first, second), origin)


def repose(line_map: LineMap, T_map_keyframe: Float64[np.ndarray, "K 4 4"]) -> LineMap:
    """Carry landmarks and cloud along with their keyframes to new poses."""
    T_new_old = T_map_keyframe @ np.linalg.inv(line_map.T_map_keyframe)
    R, t = T_new_old[:, :3, :3], T_new_old[:, :3, 3]
    keyframe = _middle_keyframe(line_map)
    endpoints = np.einsum("lij,lkj->lki", R[keyframe], line_map.lines.endpoints)
    lines = replace(line_map.lines, endpoints=endpoints + t[keyframe][:, None])
    cloud = line_map.cloud
    if cloud is not None and len(cloud):
        points = cloud.all_points().astype(np.float64)
        _, nearest = cKDTree(line_map.T_map_keyframe[:, :3, 3]).query(points)
        moved = np.einsum("pij,pj->pi", R[nearest], points) + t[nearest]
        cloud = join_clouds([moved], cloud.voxel_m)
    return replace(line_map, lines=lines, T_map_keyframe=T_map_keyframe, cloud=cloud)


def _middle_keyframe(line_map: LineMap) -> Int64[np.ndarray, "L"]:
    """Return the middle one of the keyframes that saw each landmark."""
    order = np.argsort(line_map.indices, kind="stable")  # by landmark, keyframes ascending
    starts = np.cumsum(line_map.support) - line_map.support
    return seeing(line_map)[order][starts + line_map.support // 2]


def _joined_cloud(first: LineMap, second: LineMap) -> VoxelCloud | None:
    """Return one cloud, as coarse as the coarser of the two."""
    clouds = [line_map.cloud for line_map in (first, second) if line_map.cloud is not None]
    if not clouds:
        return None
    return join_clouds(
        [cloud.all_points() for cloud in clouds], max(cloud.voxel_m for cloud in clouds)
    )

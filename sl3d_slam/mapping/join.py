"""Two maps in one frame become one."""

from dataclasses import replace

import numpy as np

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


def _joined_cloud(first: LineMap, second: LineMap) -> VoxelCloud | None:
    """Return one cloud, as coarse as the coarser of the two."""
    clouds = [line_map.cloud for line_map in (first, second) if line_map.cloud is not None]
    if not clouds:
        return None
    return join_clouds(
        [cloud.all_points() for cloud in clouds], max(cloud.voxel_m for cloud in clouds)
    )

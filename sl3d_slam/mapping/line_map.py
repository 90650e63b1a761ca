"""The line map: landmarks, keyframes and who saw what, all in the map frame."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64, Int64

from sl3d_slam.config import MapSettings
from sl3d_slam.errors import OutputError
from sl3d_slam.files import write_whole
from sl3d_slam.geometry.geodesy import GeoReference
from sl3d_slam.geometry.se3 import Transform
from sl3d_slam.mapping.build import (
    by_keyframe,
    check_counts,
    group_observations,
    keep_landmarks,
    observations_of,
    trusted,
    unique_sightings,
)
from sl3d_slam.mapping.landmarks import mean_lines
from sl3d_slam.mapping.voxels import VoxelCloud, code_voxels, collect_voxels
from sl3d_slam.types import LineSet


@dataclass(frozen=True, slots=True)
class MapOrigin:
    """Where a map comes from.

    Attributes
    ----------
    model : name and hash of the line extractor; descriptors of another model do not compare.
    config : the settings of the run, as YAML.
    simulated : whether the scans were ray-cast, not recorded.
    georeference : where on the Earth the map lies, where GPS told.
    """

    model: str = "geometric"
    config: str = ""
    simulated: bool = False
    georeference: GeoReference | None = None


@dataclass(frozen=True, eq=False)
class LineMap:
    """Landmark lines merged over the keyframes of one or several drives.

    Attributes
    ----------
    lines : the landmarks in the map frame, metres.
    T_map_keyframe : (K, 4, 4) poses of the keyframes' lidar frames.
    keyframe_up : (K, 3) unit vector up, in each keyframe's lidar frame.
    offsets : (K + 1,) int64; keyframe k saw ``indices[offsets[k] : offsets[k + 1]]``.
    indices : (S,) int64, landmarks by keyframe, ascending within each.
    cloud : occupied voxels for dense verification, or None.
    origin : model, settings, and whether the scans were simulated.
    """

    lines: LineSet
    T_map_keyframe: Float64[np.ndarray, "K 4 4"]
    keyframe_up: Float64[np.ndarray, "K 3"]
    offsets: Int64[np.ndarray, "O"]
    indices: Int64[np.ndarray, "S"]
    cloud: VoxelCloud | None = None
    origin: MapOrigin = MapOrigin()

    def __len__(self) -> int:
        """Return the number of landmarks."""
        return len(self.lines)

    @cached_property
    def support(self) -> Int64[np.ndarray, "L"]:
        """How many keyframes saw each landmark."""
        return np.bincount(self.indices, minlength=len(self)).astype(np.int64)

    @property
    def model(self) -> str:
        """Name and hash of the line extractor."""
        return self.origin.model

    @property
    def simulated(self) -> bool:
        """Whether the scans were ray-cast, not recorded."""
        return self.origin.simulated

    def seen_by(self, keyframe: int) -> Int64[np.ndarray, "M"]:
        """Return the landmarks that a keyframe saw, ascending."""
        return self.indices[self.offsets[keyframe] : self.offsets[keyframe + 1]]

    def cloud_near(
        self, position: Float64[np.ndarray, "3"], radius_m: float
    ) -> Float32[np.ndarray, "M 3"]:
        """Return cloud points within a radius as seen from above; none where no cloud is kept.

        Map frame, metres, about one point each ``cloud_voxel_m``.
        """
        if self.cloud is None:
            return np.zeros((0, 3), np.float32)
        return self.cloud.near(position, radius_m)

    @classmethod
    def build(
        cls,
        keyframe_lines: Sequence[LineSet],
        T_map_keyframe: Float64[np.ndarray, "K 4 4"],
        keyframe_up: Float64[np.ndarray, "K 3"],
        clouds: Sequence[np.ndarray] | None,
        settings: MapSettings,
        origin: MapOrigin = MapOrigin(),
    ) -> "LineMap":
        """Merge the lines of keyframes whose poses are final.

        Parameters
        ----------
        keyframe_lines : the lines of each keyframe, in its lidar frame.
        T_map_keyframe : (K, 4, 4) where each lidar frame is in the map.
        keyframe_up : (K, 3) unit vector up, in each lidar frame.
        clouds : a coarse cloud (M, 3) of each keyframe in its lidar frame, read one at a time, or
            None; kept where ``settings.clouds``.
        settings : what counts as one line, what is kept, and how fine the cloud is.
        origin : model, settings of the whole run, simulated or not.
        """
        check_counts(len(T_map_keyframe), keyframe_lines, keyframe_up, clouds)
        observations, keyframes = observations_of(keyframe_lines, T_map_keyframe, keyframe_up)
        groups = group_observations(observations, settings)
        lines = mean_lines(observations.lines, observations.weights, groups)
        sightings = unique_sightings(groups, keyframes)
        kept = trusted(lines, sightings, T_map_keyframe[:, :3, 3], settings)
        lines, sightings = keep_landmarks(lines, sightings, kept)
        cloud = None
        if clouds is not None and settings.clouds:
            voxels = collect_voxels(clouds, T_map_keyframe, settings.cloud_voxel_m)
            cloud = code_voxels(voxels, settings.cloud_voxel_m, settings.cloud_min_keyframes)
        offsets, indices = by_keyframe(sightings, len(T_map_keyframe))
        return cls(lines, T_map_keyframe, keyframe_up, offsets, indices, cloud, origin)

    def transformed(self, T_new_map: Transform) -> "LineMap":
        """Express the map in another frame; the cloud is cut into voxels anew."""
        return replace(
            self,
            lines=self.lines.transformed(T_new_map),
            T_map_keyframe=T_new_map @ self.T_map_keyframe,
            cloud=None if self.cloud is None else self.cloud.transformed(T_new_map),
        )

    def reposed(self, T_map_keyframe: Float64[np.ndarray, "K 4 4"]) -> "LineMap":
        """Carry landmarks and cloud along with keyframes whose poses were optimised anew.

        A landmark moves as the middle one of the keyframes that saw it, a point of the cloud as
        the keyframe nearest to it. Meant for corrections of decimetres; landmarks are not merged.
        """
        from sl3d_slam.mapping.join import repose

        return repose(self, T_map_keyframe)

    def joined(self, other: "LineMap", T_map_other: Transform, settings: MapSettings) -> "LineMap":
        """Return one map of both, the other's keyframes after this one's.

        Landmarks of both that are one line are merged, each counting by its support.

        Raises
        ------
        InputError
            where the two maps were made with different line models.
        """
        from sl3d_slam.mapping.join import join_maps

        return join_maps(self, other.transformed(T_map_other), settings)

    def to_bytes(self) -> bytes:
        """Return the content of the map's file; the same map gives the same bytes.

        Raises
        ------
        ValueError
            where a coordinate is not finite, or no keyframe saw a landmark.
        """
        from sl3d_slam.mapping.file import to_bytes

        return to_bytes(self)

    def save(self, path: Path | str) -> None:
        """Write the map as one file, whole or not at all.

        Raises
        ------
        OutputError
            naming the file and why it could not be written, NaN poses included.
        """
        try:
            content = self.to_bytes()
        except ValueError as error:
            raise OutputError(f"{path}: cannot be written because {error}") from None
        write_whole(Path(path), content)

    @classmethod
    def load(cls, path: Path | str) -> "LineMap":
        """Read a map file.

        Raises
        ------
        InputError
            naming the file and what was expected, where it is missing, damaged, of another kind
            or of a newer version.
        """
        from sl3d_slam.mapping.file import read_map

        return read_map(Path(path))


def seeing(line_map: LineMap) -> Int64[np.ndarray, "S"]:
    """Return the keyframe of each sighting."""
    return np.repeat(np.arange(len(line_map.keyframe_up)), np.diff(line_map.offsets))


def landmark_up(line_map: LineMap) -> Float64[np.ndarray, "L 3"]:
    """Return the way up, in the map frame, at the last keyframe that saw each landmark."""
    up = np.einsum("kij,kj->ki", line_map.T_map_keyframe[:, :3, :3], line_map.keyframe_up)
    result = np.zeros((len(line_map), 3))
    result[line_map.indices] = up[seeing(line_map)]
    return result

"""First guesses of where a view is in a line map, by the lines of both; no cloud is touched."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.spatial import cKDTree

from sl3d_slam.config import MatchingSettings
from sl3d_slam.geometry.se3 import Transform, from_yaw, invert
from sl3d_slam.loops.landmark_index import MAX_LINES, LandmarkIndex
from sl3d_slam.mapping.places import Places
from sl3d_slam.matching.prepared import PreparedView
from sl3d_slam.matching.seeds import distinct
from sl3d_slam.matching.verticals import Verticals, find_verticals

NUM_VOTED = 48
REACH_M = 1.0  # of a line from its landmark before the lines have refined the pose
CLOSE_SHARE = 0.5  # of the best line score, below which a guess is not worth a look


@dataclass(frozen=True, slots=True, eq=False)
class MapGuess:
    """A pose in the frame of a place, and the weight of the lines that agree with it."""

    keyframe: int
    T_place_lidar: Transform
    score: float


class MapRetrieval:
    """All standing landmarks of a map, by constellation and by place."""

    def __init__(self, places: Places, settings: MatchingSettings) -> None:
        self._places = places
        self._inlier_m = settings.inlier_distance_m
        line_map = places.line_map
        max_angle_rad = np.radians(2.0 * settings.angle_tolerance_deg)
        self._landmarks = find_verticals(line_map.lines, places.T_level_map, max_angle_rad)
        standing = self._landmarks.indices
        order = np.argsort(-self._landmarks.weights, kind="stable")
        ranks, number = np.full((2, len(line_map) + 1), -1)  # the last stands for no landmark
        ranks[standing[order]] = number[standing] = np.arange(len(standing))
        members = number[places.strongest(ranks[:-1], MAX_LINES)].astype(np.int32)
        self.index = LandmarkIndex(self._landmarks.xy, members)
        self._tree = cKDTree(self._landmarks.xy)

    def guesses(self, query: PreparedView, limit: int) -> list[MapGuess]:
        """Return distinct poses of a view in the map, best first, not far behind the best."""
        lines = query.verticals
        voted = self.index.query(lines.xy, lines.weights, NUM_VOTED)
        if len(voted) == 0:
            return []
        poses = self._refined(lines, voted[:, :3], REACH_M)
        scores, _ = self._line_scores(lines, poses, self._inlier_m)
        order = np.argsort(-scores, kind="stable")
        order = order[scores[order] > CLOSE_SHARE * scores[order[0]]]
        chosen = order[distinct(poses[order], limit)]
        return [self._guess(query, poses[k], float(scores[k])) for k in chosen.tolist()]

    def _line_scores(
        self, lines: Verticals, poses: Float64[np.ndarray, "K 3"], reach_m: float
    ) -> tuple[Float64[np.ndarray, "K"], tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Return the weight of agreeing lines for each pose, and weights, landmarks, places."""
        c, s = np.cos(poses[:, 0, None]), np.sin(poses[:, 0, None])
        x = c * lines.xy[:, 0] - s * lines.xy[:, 1] + poses[:, 1, None]
        y = s * lines.xy[:, 0] + c * lines.xy[:, 1] + poses[:, 2, None]
        moved = np.stack([x, y], axis=2)
        gap_m, landmark = self._tree.query(moved, distance_upper_bound=reach_m)
        landmark = np.where(np.isfinite(gap_m), landmark, 0)
        closeness = np.where(np.isfinite(gap_m), 1.0 - (gap_m / reach_m) ** 2, 0.0)
        trust = np.sqrt(lines.weights * self._landmarks.weights[landmark])
        weight = closeness * trust * self._similarity(lines, landmark)
        return weight.sum(axis=1), (weight, landmark, moved)

    def _similarity(self, lines: Verticals, landmark: np.ndarray) -> np.ndarray:
        """Return a soft weight in [0.3, 1] for each line and its landmark."""
        if lines.descriptors.shape[1] == 0:
            return np.ones(landmark.shape)
        cosine = np.einsum("vd,kvd->kv", lines.descriptors, self._landmarks.descriptors[landmark])
        return 0.3 + 0.7 * np.clip(cosine, 0.0, 1.0)

    def _refined(
        self, lines: Verticals, poses: Float64[np.ndarray, "K 3"], reach_m: float
    ) -> Float64[np.ndarray, "K 3"]:
        """Lay the lines of each pose on their landmarks, least squares."""
        _, (weight, landmark, moved) = self._line_scores(lines, poses, reach_m)
        total = np.maximum(weight.sum(axis=1), 1e-9)[:, None]
        target = self._landmarks.xy[landmark]
        from_mean = (weight[:, :, None] * moved).sum(axis=1) / total
        to_mean = (weight[:, :, None] * target).sum(axis=1) / total
        a = moved - from_mean[:, None]
        b = target - to_mean[:, None]
        dot = (weight * (a * b).sum(axis=2)).sum(axis=1)
        cross = (weight * (a[:, :, 0] * b[:, :, 1] - a[:, :, 1] * b[:, :, 0])).sum(axis=1)
        turn = np.arctan2(cross, np.where(dot == 0, 1.0, dot))
        c, s = np.cos(turn), np.sin(turn)
        shift = poses[:, 1:] - from_mean
        x = c * shift[:, 0] - s * shift[:, 1] + to_mean[:, 0]
        y = s * shift[:, 0] + c * shift[:, 1] + to_mean[:, 1]
        return np.stack([poses[:, 0] + turn, x, y], axis=1)

    def _guess(self, query: PreparedView, pose: Float64[np.ndarray, "3"], score: float) -> MapGuess:
        """Raise a planar pose to the height of the place nearest to it."""
        yaw_rad, x_m, y_m = pose.tolist()
        keyframe = self._places.nearest(x_m, y_m)
        T_level_place = self._places.T_level_map @ self._places.frame(keyframe)
        T_level_lidar = from_yaw(yaw_rad, np.array([x_m, y_m, T_level_place[2, 3]]))
        T_place_lidar = invert(T_level_place) @ T_level_lidar @ query.T_level_lidar
        return MapGuess(keyframe, T_place_lidar, score)

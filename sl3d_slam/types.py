"""The records that travel between stages; frozen, with frames and units in words."""

from dataclasses import dataclass, field, replace
from enum import IntEnum

import numpy as np
from jaxtyping import Float32, Float64, Int64, UInt8

from sl3d_slam.geometry.geodesy import GeoOrigin
from sl3d_slam.geometry.se3 import Points, Transform
from sl3d_slam.geometry.segments import transform_segments

_NOT_GIVEN = np.empty(0)


def _not_given() -> np.ndarray:
    return _NOT_GIVEN


class LineKind(IntEnum):
    """What a line was seen on; for pictures and statistics, and a weak hint in matching."""

    UNKNOWN = 0
    POLE = 1
    VERTICAL_EDGE = 2
    OTHER_EDGE = 3


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """One sweep as it was recorded.

    Attributes
    ----------
    index : position in the sequence, from 0.
    stamp_s : time of the sweep in seconds.
    points_lidar : (N, 3) metres in the sensor frame; finite.
    point_times_s : (N,) seconds within the sweep (any origin), or None where none are given.
    """

    index: int
    stamp_s: float
    points_lidar: Points
    point_times_s: Float64[np.ndarray, "N"] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class RegisteredScan:
    """A sweep with its odometry pose; points are deskewed where times were given.

    ``covariance`` is the pose's given the scans before, rotation first, at the lidar's frame; None
    where it is not known.
    """

    index: int
    stamp_s: float
    points_lidar: Points
    T_odom_lidar: Transform
    covariance: Float64[np.ndarray, "6 6"] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Keyframe:
    """A registered scan kept for lines and loops; ``id`` counts keyframes from 0."""

    id: int
    scan_index: int
    stamp_s: float
    points_lidar: Points
    T_odom_lidar: Transform


@dataclass(frozen=True, slots=True, eq=False)
class LineSet:
    """Line segments of one scan (or one map), expressed in that scan's (map's) frame.

    Attributes
    ----------
    endpoints : (L, 2, 3) float64, metres; the order of the two end points carries no meaning.
    descriptors : (L, D) float32, unit length; D = 0 where the extractor describes nothing.
    num_points : (L,) int64, how many points of the scan support each line.
    kinds : (L,) uint8, values of :class:`LineKind`; all UNKNOWN unless given.
    scores : (L,) float32 in [0, 1], the extractor's confidence; all 1 unless given.
    up : (3,) unit vector, the way up by which "standing" was judged; None where nobody says.
    ground_up : (3,) unit normal of the ground around the sensor; None where nobody says.
    """

    endpoints: Float64[np.ndarray, "L 2 3"]
    descriptors: Float32[np.ndarray, "L D"]
    num_points: Int64[np.ndarray, "L"]
    kinds: UInt8[np.ndarray, "L"] = field(default_factory=_not_given)
    scores: Float32[np.ndarray, "L"] = field(default_factory=_not_given)
    up: Float64[np.ndarray, "3"] | None = None
    ground_up: Float64[np.ndarray, "3"] | None = None

    def __post_init__(self) -> None:
        """Fill the columns that were not given and check that all have one row a line."""
        count = len(self.endpoints)
        if self.kinds is _NOT_GIVEN:
            object.__setattr__(self, "kinds", np.zeros(count, np.uint8))
        if self.scores is _NOT_GIVEN:
            object.__setattr__(self, "scores", np.ones(count, np.float32))
        columns = (self.descriptors, self.num_points, self.kinds, self.scores)
        if any(len(column) != count for column in columns):
            raise ValueError(f"a LineSet needs {count} rows in every column, one for each segment")

    def __len__(self) -> int:
        """Return the number of lines."""
        return len(self.endpoints)

    def take(self, indices: np.ndarray) -> "LineSet":
        """Return the chosen lines, in the order of ``indices`` (integers or a mask)."""
        return LineSet(
            self.endpoints[indices],
            self.descriptors[indices],
            self.num_points[indices],
            self.kinds[indices],
            self.scores[indices],
            self.up,
            self.ground_up,
        )

    def transformed(self, T_a_b: Transform) -> "LineSet":
        """Express lines given in frame b in frame a."""
        return replace(
            self,
            endpoints=transform_segments(T_a_b, self.endpoints),
            up=None if self.up is None else T_a_b[:3, :3] @ self.up,
            ground_up=None if self.ground_up is None else T_a_b[:3, :3] @ self.ground_up,
        )


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """What is kept of one scan for matching, all in its lidar frame.

    Attributes
    ----------
    lines : the lines of the scan.
    up : (3,) unit vector, the way up.
    cloud : (N, 3) float32, a coarse cloud for dense verification; may be empty.
    heights : (N,) float32, metres of each cloud point above the local ground.
    """

    lines: LineSet
    up: Float64[np.ndarray, "3"]
    cloud: Float32[np.ndarray, "N 3"]
    heights: Float32[np.ndarray, "N"]


@dataclass(frozen=True, slots=True, eq=False)
class Registration:
    """The answer to "where is the source scan in the target frame?".

    Attributes
    ----------
    success : whether ``T_target_source`` may be used.
    T_target_source : (4, 4) or None where there is no answer.
    num_inliers : matched lines that agree with the pose.
    matches : (M, 2) indices of those lines, source first.
    information : (6, 6) inverse covariance of ``T_target_source``, rotation first (GTSAM), at the
        source frame; zero rows and columns for directions that nothing fixes.
    reason : empty on success, else one sentence.
    """

    success: bool
    T_target_source: Transform | None
    num_inliers: int
    matches: Int64[np.ndarray, "M 2"]
    information: Float64[np.ndarray, "6 6"]
    reason: str = ""
    overlap: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Relocalization:
    """The answer to "where in the map is this scan?".

    Attributes
    ----------
    success : whether ``T_map_lidar`` may be used.
    T_map_lidar : (4, 4) or None where there is no answer.
    information : (6, 6) inverse covariance, rotation first (GTSAM), at the lidar frame.
    num_inliers : standing lines of the scan that lie on landmarks.
    confidence : in [0, 1]; 0 without an answer.
    reason : empty on success, else one sentence.
    """

    success: bool
    T_map_lidar: Transform | None
    information: Float64[np.ndarray, "6 6"]
    num_inliers: int
    confidence: float
    reason: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class LoopConstraint:
    """A verified relative pose between two keyframes; ``query`` is newer, ``target`` older.

    ``information`` is in GTSAM's order (rotation first) at the query frame.
    """

    target_id: int
    query_id: int
    T_target_query: Transform
    information: Float64[np.ndarray, "6 6"]
    num_inliers: int


@dataclass(frozen=True, slots=True, eq=False)
class Rejection:
    """Why a candidate was not used; kept so that a run can be explained afterwards."""

    target_id: int
    query_id: int
    reason: str
    T_target_query: Transform | None = None
    num_inliers: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class LoopRecord:
    """One verified candidate as it ends in ``loops.json``; scans by their index in the sequence.

    ``status`` is accepted, rejected or revoked; ``reason`` is empty for accepted ones.
    """

    query_scan: int
    target_scan: int
    T_target_query: Transform
    num_inliers: int
    status: str
    reason: str


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """Poses over time: ``stamps_s`` (N,) and ``T_world_lidar`` (N, 4, 4)."""

    stamps_s: Float64[np.ndarray, "N"]
    T_world_lidar: Float64[np.ndarray, "N 4 4"]

    def __len__(self) -> int:
        """Return the number of poses."""
        return len(self.stamps_s)


@dataclass(frozen=True, slots=True, eq=False)
class PositionFixes:
    """Positions of an antenna by GPS, in the clock of the scans.

    Attributes
    ----------
    stamps_s : (N,) seconds.
    positions_enu : (N, 3) metres east, north and up of ``origin``, or of a frame of their own.
    sigmas_m : (N, 3) standard deviations, one an axis.
    origin : None where the positions were given in metres.
    """

    stamps_s: Float64[np.ndarray, "N"]
    positions_enu: Points
    sigmas_m: Float64[np.ndarray, "N 3"]
    origin: GeoOrigin | None = None


@dataclass(frozen=True, slots=True, eq=False)
class UpFixes:
    """Which way is up, by gravity or an IMU, in the clock of the scans.

    ``up_lidar`` (N, 3) are unit vectors in the lidar frame, ``sigmas_rad`` (N,) their errors.
    """

    stamps_s: Float64[np.ndarray, "N"]
    up_lidar: Points
    sigmas_rad: Float64[np.ndarray, "N"]


@dataclass(frozen=True, slots=True, eq=False)
class WorldMeasurements:
    """What other sensors say of where the drive is in the world; either may be None."""

    positions: PositionFixes | None = None
    ups: UpFixes | None = None

    def __bool__(self) -> bool:
        """Tell whether there is anything."""
        return self.positions is not None or self.ups is not None


@dataclass(frozen=True, slots=True, eq=False)
class KeyframeCovariances:
    """Marginals of keyframe poses.

    ``covariances`` (K, 6, 6) are rotation first, each at its own lidar frame, for the scans in
    ``scans``; ``relative_to`` says in words what they are measured against.
    """

    scans: list[int]
    covariances: Float64[np.ndarray, "K 6 6"]
    relative_to: str

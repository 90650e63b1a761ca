"""Lines of one scan: the one way in, learned or geometric."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float64

from sl3d_slam.config import LineSettings
from sl3d_slam.errors import InputError, MissingExtraError
from sl3d_slam.types import LineSet

if TYPE_CHECKING:
    from sl3d_slam.lines.geometric import Proposal
    from sl3d_slam.lines.network.inference import Network

MIN_POINTS = 50
SHIPPED_WEIGHTS = Path(__file__).parent / "weights" / "superline3d.safetensors"


class LineExtractor:
    """Finds standing poles and building edges in one scan.

    Deterministic, and tied to no sensor: only the coordinates count, not their order. Poles, posts
    and trunks are narrow columns (LineKind.POLE; the line is the axis behind the visible front).
    Standing edges are where two walls meet or one truly ends (LineKind.VERTICAL_EDGE). "Standing"
    is meant along gravity as most of what stands shows it, or, where too little does or it agrees
    with the ground to a degree, against the ground around the sensor, which may be tilted by up to
    25 degrees. The lines say which way is ``up``.

    With ``settings.method`` "geometric" local structure alone decides, and lines are described by a
    small hand-made descriptor. With "learned" the network of ``settings.weights`` (or the one
    shipped with the package) says which points belong to lines, ranks the lines and describes them.
    """

    def __init__(
        self,
        settings: LineSettings = LineSettings(),  # noqa: B008  (frozen)
        device: str = "cpu",
    ) -> None:
        self._settings = settings
        self._network = _network(settings, device) if settings.method == "learned" else None

    @classmethod
    def pretrained(cls, device: str = "cpu") -> "LineExtractor":
        """Return the learned extractor with the weights shipped in this package.

        Raises
        ------
        MissingExtraError
            where this installation ships no weights.
        InputError
            where they are damaged or the device is unknown.
        """
        return cls(LineSettings(method="learned"), device)

    @property
    def model(self) -> str:
        """What describes the lines: "geometric", or "superline3d-" and the hash of the weights.

        Descriptors of different models cannot be compared.
        """
        return "geometric" if self._network is None else self._network.name

    def extract(self, points_lidar: np.ndarray) -> LineSet:
        """Return the lines of a scan (N, 3) in metres, in the lidar frame, best score first.

        Descriptors (L, D) are unit vectors: the mean of the network's over the points of a line, or
        what :func:`sl3d_slam.lines.describe.describe_uprights` says of it. A scan without structure
        gives an empty set. A sweep of a moving sensor should be deskewed before: at 10 m/s lines
        of raw sweeps disagree by twice as much.

        Raises
        ------
        InputError
            where the array is no (N, 3) of finite floats or has fewer than 50 points.
        """
        points = checked_points(points_lidar)
        if self._network is None:
            return self.extract_from(self.propose(points))
        from sl3d_slam.lines.learned import learned_lines

        return learned_lines(points, self._settings, self._network)

    def propose(self, points_lidar: np.ndarray) -> "Proposal":
        """Return what geometry proposes in a scan, where more than one method will be asked.

        Raises
        ------
        InputError
            as :meth:`extract` does.
        """
        from sl3d_slam.lines.geometric import propose

        return propose(checked_points(points_lidar), self._settings)

    def extract_from(self, proposal: "Proposal") -> LineSet:
        """Return what :meth:`extract` finds in the scan that a proposal was made of."""
        if self._network is None:
            from sl3d_slam.lines.geometric import geometric_lines

            return geometric_lines(proposal, self._settings)
        from sl3d_slam.lines.learned import learned_lines_of

        return learned_lines_of(proposal, self._settings, self._network)


def _network(settings: LineSettings, device: str) -> "Network":
    from sl3d_slam.lines.network.inference import Network

    if settings.weights is not None:
        return Network(Path(settings.weights), device)
    if not SHIPPED_WEIGHTS.is_file():
        raise MissingExtraError(
            "no trained line network ships with this installation; "
            "name one with lines.weights or set lines.method to geometric"
        )
    return Network(SHIPPED_WEIGHTS, device)


def checked_points(points_lidar: np.ndarray) -> Float64[np.ndarray, "N 3"]:
    """Return the points as float64, or say what is wrong with them."""
    points = np.asarray(points_lidar)
    if points.ndim != 2 or points.shape[1] != 3 or not np.issubdtype(points.dtype, np.floating):
        raise InputError(
            f"points_lidar: expected a float array (N, 3), found {points.dtype} {points.shape}"
        )
    if len(points) < MIN_POINTS:
        raise InputError(f"points_lidar: {len(points)} points; a scan has at least {MIN_POINTS}")
    if not np.isfinite(points).all():
        raise InputError("points_lidar: NaN or infinite coordinates; drop those points first")
    return np.ascontiguousarray(points, dtype=np.float64)

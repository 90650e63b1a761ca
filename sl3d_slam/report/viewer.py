"""A map and a run in 3D, by rerun; the only import of it."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64, Int64

from sl3d_slam.errors import MissingExtraError, OutputError
from sl3d_slam.types import LineKind, LineSet

COLOURS = {
    LineKind.UNKNOWN: (150, 150, 150),
    LineKind.POLE: (230, 120, 30),
    LineKind.VERTICAL_EDGE: (40, 110, 200),
    LineKind.OTHER_EDGE: (70, 160, 90),
}
CLOUD = (120, 120, 120)
TRAJECTORY, ODOMETRY = (30, 30, 30), (200, 160, 160)
LOOPS = {"accepted": (30, 160, 60), "rejected": (200, 60, 50), "revoked": (150, 60, 160)}


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """What a map shows, metres in the map frame; ``support`` tells how often a line was seen."""

    lines: LineSet
    support: Int64[np.ndarray, "L"]
    keyframes: Float64[np.ndarray, "K 3"]
    cloud: Float32[np.ndarray, "V 3"]
    simulated: bool


@dataclass(frozen=True, slots=True, eq=False)
class Street:
    """Where a run went, scan by scan, and its loops (query scan, target scan, status)."""

    trajectory: Float64[np.ndarray, "N 3"]
    odometry: Float64[np.ndarray, "N 3"]
    loops: list[tuple[int, int, str]]


def show(scene: Scene, street: Street | None, out: Path | None) -> None:
    """Open the viewer, or write a recording where ``out`` is given.

    Raises
    ------
    MissingExtraError
        where rerun is not installed.
    OutputError
        where the recording cannot be written.
    """
    try:
        import rerun
    except ImportError:
        raise MissingExtraError(
            "the viewer needs rerun; install it with: pip install 'sl3d-slam[view]'"
        ) from None
    recording = rerun.RecordingStream("sl3d_simulated" if scene.simulated else "sl3d")
    if out is None:
        recording.spawn()
    elif not out.parent.is_dir():
        raise OutputError(f"{out}: its folder does not exist")
    else:
        recording.save(out)
    recording.log("map", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    _log_map(rerun, recording, scene)
    if street is not None:
        _log_run(rerun, recording, street)
    recording.flush()


def _log_map(rerun: Any, recording: Any, scene: Scene) -> None:
    for kind in LineKind:
        rows = np.flatnonzero(scene.lines.kinds == kind)
        if len(rows):
            strips = rerun.LineStrips3D(
                scene.lines.endpoints[rows].astype(np.float32),
                colors=[COLOURS[kind]],
                radii=0.02 + 0.01 * np.log1p(scene.support[rows]),
            )
            recording.log(f"map/lines/{kind.name.lower()}", strips, static=True)
    cloud = rerun.Points3D(scene.cloud, colors=[CLOUD], radii=0.05)
    recording.log("map/cloud", cloud, static=True)
    keyframes = rerun.Points3D(scene.keyframes, colors=[TRAJECTORY], radii=0.25)
    recording.log("map/keyframes", keyframes, static=True)


def _log_run(rerun: Any, recording: Any, street: Street) -> None:
    for name, way, colour in (
        ("trajectory", street.trajectory, TRAJECTORY),
        ("odometry", street.odometry, ODOMETRY),
    ):
        strip = rerun.LineStrips3D([way.astype(np.float32)], colors=[colour], radii=0.1)
        recording.log(f"map/{name}", strip, static=True)
    for status, colour in LOOPS.items():
        ends = [(query, target) for query, target, found in street.loops if found == status]
        if ends:
            strips = street.trajectory[np.array(ends)].astype(np.float32)
            recording.log(
                f"map/loops/{status}",
                rerun.LineStrips3D(strips, colors=[colour], radii=0.08),
                static=True,
            )

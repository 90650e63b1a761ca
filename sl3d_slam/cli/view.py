"""``sl3d view``: a line map or a run in the rerun viewer, or as a recording for it."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sl3d_slam.cli.options import QuietOption

if TYPE_CHECKING:
    from sl3d_slam.mapping.line_map import LineMap
    from sl3d_slam.report.viewer import Scene, Street

MAP_NAME = "map.sl3d"
SUFFIX = ".rrd"


def view(
    what: Annotated[
        Path, typer.Argument(metavar="MAP|RUN", help="A map.sl3d, or a folder of sl3d map.")
    ],
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="FILE", help="Write a recording (.rrd), open nothing."),
    ] = None,
    quiet: QuietOption = False,
) -> None:
    """Show landmarks, cloud, trajectory and loops in 3D (needs the view extra)."""
    from sl3d_slam.files import prove_writable
    from sl3d_slam.mapping.line_map import LineMap
    from sl3d_slam.report.viewer import show

    if out is not None:
        prove_writable(out, (SUFFIX,))
    is_run = what.is_dir()
    loaded = LineMap.load(what / MAP_NAME if is_run else what)
    show(_scene(loaded), _street(what) if is_run else None, out)
    if out is not None and not quiet:
        typer.echo(f"{len(loaded)} landmarks -> {out}; open it with: rerun {out}")


def _scene(line_map: "LineMap") -> "Scene":
    import numpy as np

    from sl3d_slam.report.viewer import Scene

    cloud = np.zeros((0, 3), np.float32)
    if line_map.cloud is not None:
        cloud = line_map.cloud.all_points()
    return Scene(
        line_map.lines,
        line_map.support,
        line_map.T_map_keyframe[:, :3, 3],
        cloud,
        line_map.simulated,
    )


def _street(folder: Path) -> "Street":
    from sl3d_slam.io.trajectory import read_tum
    from sl3d_slam.report.viewer import Street

    trajectory = read_tum(folder / "poses_tum.txt").T_world_lidar[:, :3, 3]
    odometry = read_tum(folder / "odometry_tum.txt").T_world_lidar[:, :3, 3]
    return Street(trajectory, odometry, _loops(folder / "loops.json", len(trajectory)))


def _loops(path: Path, num_scans: int) -> list[tuple[int, int, str]]:
    from json import loads

    from sl3d_slam.errors import InputError

    try:
        loops = [
            (int(loop["query_scan"]), int(loop["target_scan"]), str(loop["status"]))
            for loop in loads(path.read_text(encoding="utf-8"))
        ]
    except (OSError, ValueError, RecursionError, TypeError, KeyError):
        raise InputError(f"{path}: expected the loops that sl3d map writes there") from None
    if any(not 0 <= index < num_scans for loop in loops for index in loop[:2]):
        raise InputError(f"{path}: names scans that the run's {num_scans} poses do not have")
    return loops

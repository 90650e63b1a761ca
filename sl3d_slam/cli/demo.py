"""``sl3d demo``: simulate a drive, map it, find scans of another day in the map. No download."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sl3d_slam.cli.options import QuietOption

if TYPE_CHECKING:
    from sl3d_slam.io.dataset import Dataset
    from sl3d_slam.simulation.drive import Drive
    from sl3d_slam.types import Scan

NUM_QUERIES = 8
RIGHT_M, RIGHT_DEG = 2.0, 5.0


def demo(
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Where to write.")] = Path(
        "sl3d_demo"
    ),
    seed: Annotated[int, typer.Option(min=0, help="Another seed, another town.")] = 3,
    quiet: QuietOption = False,
) -> None:
    """Map a simulated street drive with a loop, then relocalize scans of another day in the map."""
    from rich.console import Console

    from sl3d_slam.cli.map import Mapping, run_map
    from sl3d_slam.config import load_config
    from sl3d_slam.files import prepare_run_folder
    from sl3d_slam.report.summary import summary_table
    from sl3d_slam.simulation.drive import plan_drive
    from sl3d_slam.simulation.roads import builtin_road
    from sl3d_slam.simulation.town import build_town

    prepare_run_folder(out)
    console = Console(quiet=quiet)
    town = build_town(builtin_road("demo"), seed)
    drive = plan_drive(town)
    console.print(
        f"Mapping a simulated drive of {len(drive)} scans (the first one compiles the kernels) ..."
    )
    figures = run_map(as_dataset(drive, "demo"), out, Mapping(load_config(), quiet=quiet))
    console.print(summary_table(figures, "simulated drive"))
    console.print("Relocalizing scans of another day, sensor turned at random, no first guess ...")
    num_right = _relocalize(out, plan_drive(town, day=1), seed, console)
    console.print(f"{num_right} of {NUM_QUERIES} found where they are. Pictures and map in {out}/:")
    console.print("trajectory.png  map.png  relocalization.png  map.sl3d")


def as_dataset(drive: "Drive", name: str) -> "Dataset":
    """Present a simulated drive as a dataset; its scans are cast while they are read."""
    from sl3d_slam.io.dataset import Dataset
    from sl3d_slam.simulation.drive import simulate_drive
    from sl3d_slam.types import Scan

    def read_scans(start: int, stop: int) -> "Iterator[Scan]":
        for index, cast in enumerate(simulate_drive(drive, range(start, stop)), start):
            yield Scan(index, 0.1 * index, cast.points_lidar)

    return Dataset(
        name=name,
        description=f"a simulated town drive, seed {drive.town.seed}, day {drive.day}",
        num_scans=len(drive),
        read_scans=read_scans,
        truth=drive.T_town_lidar,
        simulated=True,
    )


def _relocalize(out: Path, drive: "Drive", seed: int, console: Any) -> int:
    """Ask for scans spread over a drive; print each answer, draw the last, count the right ones."""
    import numpy as np

    from sl3d_slam.cli.relocalize import sentence
    from sl3d_slam.files import write_whole
    from sl3d_slam.geometry.se3 import (
        distance_m,
        from_yaw,
        invert,
        rotation_angle_rad,
        transform_points,
    )
    from sl3d_slam.mapping.line_map import LineMap
    from sl3d_slam.relocalization.relocalizer import Relocalizer
    from sl3d_slam.report.pictures import draw_relocalization
    from sl3d_slam.simulation.drive import simulate_drive

    line_map = LineMap.load(out / "map.sl3d")
    relocalizer = Relocalizer(line_map)
    rng = np.random.default_rng(seed)
    num_right = 0
    chosen = np.linspace(5, len(drive) - 5, NUM_QUERIES).astype(int).tolist()
    for index, cast in zip(chosen, simulate_drive(drive, chosen), strict=True):
        T_turned_lidar = from_yaw(rng.uniform(-np.pi, np.pi), np.zeros(3))
        points = transform_points(T_turned_lidar, cast.points_lidar)
        T_map_true = drive.T_town_lidar[index] @ invert(T_turned_lidar)
        answer = relocalizer.relocalize(points)
        if answer.T_map_lidar is None:
            console.print(f"  scan {index}: {sentence(answer)}")
            continue
        T_error = invert(T_map_true) @ answer.T_map_lidar
        error_m, error_deg = distance_m(T_error), np.degrees(rotation_angle_rad(T_error))
        num_right += bool(error_m < RIGHT_M and error_deg < RIGHT_DEG)
        console.print(
            f"  scan {index}: {sentence(answer)}; off by {error_m:.2f} m, {error_deg:.2f} deg"
        )
        picture = draw_relocalization(
            line_map.lines,
            line_map.T_map_keyframe,
            points,
            answer.T_map_lidar,
            T_map_true,
            f"scan {index} of another day in the saved map (simulated)",
        )
        write_whole(out / "relocalization.png", picture)
    return num_right

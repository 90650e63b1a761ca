"""The simulated towns that the shipped weights learned from."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from sl3d_slam.errors import InputError
from sl3d_slam.files import prepare_run_folder, write_whole
from sl3d_slam.simulation.drive import plan_drive
from sl3d_slam.simulation.roads import Road, read_road
from sl3d_slam.simulation.town import build_town
from sl3d_slam.simulation.write import Layout, write_drive

SPACING_M = 3.0
SHORTEST_SHARE = 0.97


class TownPlan(NamedTuple):
    """A stretch of a KITTI odometry trajectory, and the town along it; ``seed`` names both."""

    seed: int
    trajectory: str
    first_pose: int
    scans: int
    sensor: str = "hdl64"


TOWNS = (
    TownPlan(21, "02", 0, 90),
    TownPlan(22, "08", 100, 90),
    TownPlan(23, "05", 300, 90),
    TownPlan(24, "09", 200, 90),
    TownPlan(25, "10", 50, 90),
    TownPlan(26, "08", 2000, 80, "hdl32"),
    TownPlan(27, "02", 2500, 80, "os1-128"),
    TownPlan(28, "03", 0, 90),
    TownPlan(29, "05", 1500, 90),
    TownPlan(30, "00", 2500, 90),
    TownPlan(31, "02", 1200, 90),
    TownPlan(32, "09", 900, 80, "hdl32"),
    TownPlan(33, "08", 3000, 90),
    TownPlan(34, "10", 600, 90),
    TownPlan(35, "00", 1200, 90),
    TownPlan(60, "00", 200, 90),
    TownPlan(61, "00", 3400, 90),
    TownPlan(62, "02", 3300, 90),
    TownPlan(63, "02", 4000, 90),
    TownPlan(64, "05", 800, 90),
    TownPlan(65, "05", 2200, 90),
    TownPlan(66, "08", 700, 90),
    TownPlan(67, "08", 1400, 90),
    TownPlan(69, "04", 0, 90),
    TownPlan(71, "08", 2600, 90),
)
HELD_OUT = TownPlan(40, "06", 0, 80)


def simulate_towns(
    trajectories: Path,
    out: Path,
    plans: tuple[TownPlan, ...] = (*TOWNS, HELD_OUT),
    progress: Callable[[str], None] = lambda _: None,
) -> list[Path]:
    """Write the towns below ``out/sequences`` and return their folders.

    ``trajectories`` holds the pose files of KITTI odometry, ``00.txt`` and so on. A town that is
    there already is left alone, so that an interrupted call can be repeated.

    Raises
    ------
    InputError
        naming a pose file that is missing, damaged or too short.
    OutputError
        where a town cannot be written.
    """
    folders = []
    for plan in plans:
        layout = Layout(out, f"{plan.seed}")
        if not layout.folder.is_dir():
            road = _stretch(trajectories, plan, out)
            drive = plan_drive(build_town(road, plan.seed), plan.sensor)
            write_drive(drive, layout, partial(progress, f"town {plan.seed}"))
        folders.append(layout.folder)
    return folders


def _stretch(trajectories: Path, plan: TownPlan, out: Path) -> Road:
    """Keep a pose every three metres of a stretch, as ``out/roads/SEED.txt``, and read it."""
    path = trajectories / f"{plan.trajectory}.txt"
    read_road(path)  # says what is wrong with a file that is no trajectory
    rows = np.loadtxt(path, ndmin=2)[plan.first_pose :]
    chosen = every_three_metres(rows[:, [3, 7, 11]], plan.scans)
    if len(chosen) < plan.scans:
        raise InputError(
            f"{path}: {len(chosen)} poses three metres apart after pose {plan.first_pose}; "
            f"expected {plan.scans}"
        )
    road = prepare_run_folder(out / "roads") / f"{plan.seed}.txt"
    lines = (" ".join(f"{value:.9e}" for value in row) for row in rows[chosen])
    write_whole(road, "\n".join(lines) + "\n")
    return read_road(road)


def every_three_metres(places: Float64[np.ndarray, "N 3"], count: int) -> list[int]:
    """Return the rows of at most ``count`` places, each three metres of way after the last."""
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(places, axis=0), axis=1))])
    chosen: list[int] = []
    for row, travelled_m in enumerate(way):
        if not chosen or travelled_m - way[chosen[-1]] >= SHORTEST_SHARE * SPACING_M:
            chosen.append(row)
        if len(chosen) == count:
            break
    return chosen

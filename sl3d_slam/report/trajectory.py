"""The picture of a run: where it went, which loops closed, how far it is from the truth."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float64

from sl3d_slam.geometry.se3 import Points, distances_travelled_m, transform_points
from sl3d_slam.report.metrics import Poses, align
from sl3d_slam.report.style import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    draw_segments,
    new_figure,
    picture_style,
    style_axes,
    style_plan,
    to_png,
)
from sl3d_slam.types import LoopRecord, Trajectory

LOOP_STYLES: dict[str, dict[str, Any]] = {
    "rejected": {"color": GREY, "linewidth": 0.5, "alpha": 0.25, "zorder": 1.5},
    "revoked": {"color": PURPLE, "linewidth": 1.2, "linestyle": "--", "zorder": 4},
    "accepted": {"color": GREEN, "linewidth": 1.6, "zorder": 5},
}
PATH_STYLES: dict[str, dict[str, Any]] = {
    "truth": {"color": BLACK, "lw": 3.5, "alpha": 0.35, "zorder": 2},
    "odometry": {"color": ORANGE, "lw": 1.4, "ls": (0, (4, 1.5)), "zorder": 3},
    "result": {"color": BLUE, "lw": 1.6, "zorder": 3.5},
}


def draw_trajectory(
    result: Trajectory,
    odometry: Trajectory,
    truth: Poses | None,
    loops: Sequence[LoopRecord],
    title: str,
) -> bytes:
    """Return a PNG: truth, odometry and result from above with the loops; heights; errors.

    One pose a scan in each, so that a loop's scan numbers are their rows. Where the truth is
    known both paths are laid on it by the same rigid alignment that the ATE uses.
    """
    paths = _aligned_paths(result, odometry, truth)
    with picture_style():
        figure = new_figure(13.0, 7.0, title)
        grid = figure.add_gridspec(2, 2, width_ratios=[1.6, 1.0])
        plan = figure.add_subplot(grid[:, 0])
        _draw_plan(plan, paths, loops)
        lower = figure.add_subplot(grid[1, 1])
        travelled_km = _travelled_km(paths["result"] if truth is None else paths["truth"])
        _draw_heights(lower, paths, travelled_km)
        upper = figure.add_subplot(grid[0, 1], sharex=lower)
        _draw_differences(upper, paths, travelled_km)
        return to_png(figure)


def _aligned_paths(
    result: Trajectory, odometry: Trajectory, truth: Poses | None
) -> dict[str, Points]:
    paths = {
        "odometry": odometry.T_world_lidar[:, :3, 3],
        "result": result.T_world_lidar[:, :3, 3],
    }
    if truth is None:
        return paths
    place = truth[:, :3, 3]
    aligned = {name: transform_points(align(path, place), path) for name, path in paths.items()}
    return {"truth": place, **aligned}


def _draw_plan(axes: Any, paths: dict[str, Points], loops: Sequence[LoopRecord]) -> None:
    for name, path in paths.items():
        label = name if name != "result" else "result (lines and loops)"
        axes.plot(path[:, 0], path[:, 1], label=label, **PATH_STYLES[name])
    start = paths["result"][0]
    axes.plot(start[0], start[1], "o", ms=8, mfc="white", mec=BLACK, label="start", zorder=6)
    _draw_loops(axes, paths["result"], loops)
    style_plan(axes)
    axes.legend(loc="best", framealpha=0.9)
    axes.set_title("seen from above")


def _draw_loops(axes: Any, path: Points, loops: Sequence[LoopRecord]) -> None:
    for status, style in LOOP_STYLES.items():
        ends = [(loop.target_scan, loop.query_scan) for loop in loops if loop.status == status]
        if not ends:
            continue
        chords = path[np.array(ends)][:, :, :2]
        draw_segments(axes, chords, **style)
        mark = {"color": style["color"], "zorder": style["zorder"]}
        size = 1.5 if status == "rejected" else 4.0
        axes.plot(chords[:, :, 0].ravel(), chords[:, :, 1].ravel(), ".", ms=size, **mark)
        axes.plot([], [], marker=".", label=f"loops {status}: {len(ends)}", **style)


def _draw_differences(axes: Any, paths: dict[str, Points], at: Float64[np.ndarray, "N"]) -> None:
    names = ("odometry", "result") if "truth" in paths else ("odometry",)
    reference = "truth" if "truth" in paths else "result"
    for name in names:
        error_m = np.linalg.norm(paths[name] - paths[reference], axis=1)
        rmse_m = float(np.sqrt(np.mean(error_m**2)))
        label = f"{name}: RMSE {rmse_m:.3f} m" if "truth" in paths else f"{name} to result"
        axes.plot(at, error_m, label=label, **PATH_STYLES[name])
    axes.set_ylim(bottom=0.0)
    axes.set_title(f"distance from the {reference}")
    axes.set_ylabel("m")
    axes.tick_params(labelbottom=False)
    style_axes(axes)
    axes.legend(loc="best", framealpha=0.9)


def _draw_heights(axes: Any, paths: dict[str, Points], at: Float64[np.ndarray, "N"]) -> None:
    for name, path in paths.items():
        axes.plot(at, path[:, 2], **PATH_STYLES[name])
    axes.set_title("height")
    axes.set_ylabel("z (m)")
    axes.set_xlabel("distance travelled (km)")
    style_axes(axes)


def _travelled_km(path: Points) -> Float64[np.ndarray, "N"]:
    return distances_travelled_m(path) / 1000.0

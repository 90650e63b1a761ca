"""Pictures of a line map, and of a scan that was found in it."""

from typing import Any

import numpy as np
from jaxtyping import Float64

from sl3d_slam.geometry.se3 import Points, Transform, distance_m, invert, transform_points
from sl3d_slam.report.line_drawing import draw_plan_lines
from sl3d_slam.report.style import (
    BLACK,
    GREY,
    PURPLE,
    Plane,
    Window,
    draw_cloud,
    height_shade,
    new_figure,
    page_size,
    picture_style,
    show_window,
    to_png,
)
from sl3d_slam.types import LineSet, Trajectory

CLOSE_UP_M = 60.0
MARGIN_M = 10.0


def draw_map(lines: LineSet, trajectory: Trajectory, title: str) -> bytes:
    """Return a PNG: the map's lines from above by kind, the path driven and a scale bar."""
    path = trajectory.T_world_lidar[:, :2, 3]
    window = _bounds(lines, path)
    width, height = page_size(window[1] - window[0], 10.0)
    with picture_style():
        figure = new_figure(width + 1.0, height + 1.0, title)
        axes = figure.add_subplot()
        axes.plot(path[:, 0], path[:, 1], color=BLACK, lw=1.0, zorder=2, label="path driven")
        axes.plot(*path[0], "o", ms=7, mfc="white", mec=BLACK, zorder=5, label="start")
        draw_plan_lines(axes, lines)
        show_window(axes, window)
        axes.legend(loc="best", framealpha=0.9)
        return to_png(figure)


def draw_relocalization(
    map_lines: LineSet,
    T_map_keyframe: Float64[np.ndarray, "K 4 4"],
    query_points: Points,
    T_map_lidar: Transform,
    T_truth: Transform | None = None,
    title: str = "",
) -> bytes:
    """Return a PNG: where in the map a scan was found, and a close-up of the scan on the lines."""
    keyframes = T_map_keyframe[:, :2, 3]
    window = _bounds(map_lines, keyframes)
    with picture_style():
        figure = new_figure(14.0, 7.0, title)
        plan, close = figure.subplots(1, 2)
        plan.plot(*keyframes.T, ".", ms=2, color=BLACK, zorder=2, label="keyframes")
        draw_plan_lines(plan, map_lines)
        show_window(plan, window)
        plan.set_title("in the whole map")
        _draw_close_up(close, map_lines, transform_points(T_map_lidar, query_points), T_map_lidar)
        for axes, length_m in ((plan, 0.06 * float((window[1] - window[0]).max())), (close, 6.0)):
            if T_truth is not None:
                draw_pose(axes, T_truth, length_m, PURPLE, "true pose")
            draw_pose(axes, T_map_lidar, length_m, BLACK, "pose found")
        close.set_title(_close_title(T_map_lidar, T_truth))
        close.legend(loc="upper right", framealpha=0.9)
        return to_png(figure)


def draw_pose(axes: Any, T_map_lidar: Transform, length_m: float, colour: str, label: str) -> None:
    """Draw a pose from above as a ring with an arrow along the sensor's x axis."""
    at = T_map_lidar[:2, 3]
    axes.plot(at[0], at[1], "o", ms=11, mfc="none", mec=colour, mew=2.2, label=label, zorder=8)
    tip = at + length_m * T_map_lidar[:2, 0]
    arrow = {"arrowstyle": "-|>", "color": colour, "lw": 2.2, "shrinkA": 5, "shrinkB": 0}
    axes.annotate("", xy=tuple(tip), xytext=tuple(at), arrowprops=arrow, zorder=8)


def _draw_close_up(axes: Any, lines: LineSet, points_map: Points, T_map_lidar: Transform) -> None:
    at = T_map_lidar[:2, 3]
    near = points_map[np.abs(points_map[:, :2] - at).max(axis=1) < CLOSE_UP_M]
    draw_cloud(axes, near[:, :2], height_shade(near[:, 2]))
    draw_plan_lines(axes, lines, label=False)
    axes.plot([], [], "s", ms=6, color=GREY, label="points of the scan")
    show_window(axes, (at - CLOSE_UP_M, at + CLOSE_UP_M))
    axes.grid(False)


def _close_title(T_map_lidar: Transform, T_truth: Transform | None) -> str:
    if T_truth is None:
        return "the scan on the map's lines"
    return f"{distance_m(invert(T_truth) @ T_map_lidar):.2f} m from the true pose"


def _bounds(lines: LineSet, path: Plane) -> Window:
    at = np.concatenate([lines.endpoints[:, :, :2].reshape(-1, 2), path])
    return at.min(axis=0) - MARGIN_M, at.max(axis=0) + MARGIN_M

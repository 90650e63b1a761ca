"""Pictures of one scan with its lines, and of two scans brought together."""

from typing import Any

import numpy as np
from jaxtyping import Float64, Int64

from sl3d_slam.geometry.se3 import Points, Transform, transform_points
from sl3d_slam.report.line_drawing import (
    draw_pairs,
    draw_plan_lines,
    kind_colours,
    line_places,
)
from sl3d_slam.report.style import (
    BLACK,
    BLUE,
    GREEN,
    VERMILION,
    Window,
    draw_cloud,
    draw_segments,
    height_shade,
    new_figure,
    picture_style,
    show_window,
    style_axes,
    to_png,
)
from sl3d_slam.types import LineSet

SAMPLES_PER_LINE = 24
VIEW_M = 60.0
PAGE_IN = 13.0
GROUND_SHADE = 0.1
LOWEST_DEG = -14.0

TwoClouds = tuple[Float64[np.ndarray, "S 3"], Float64[np.ndarray, "T 3"]]  # source, target


def draw_lines(points_lidar: Points, lines: LineSet, title: str) -> bytes:
    """Return a PNG: a scan and its lines from above and all around as the sensor sees them."""
    with picture_style():
        window = _window(points_lidar)
        plan_height = PAGE_IN * _height_to_width(window)
        figure = new_figure(PAGE_IN, plan_height + 5.0, title)
        ratios = [plan_height + 0.3, 3.7]
        plan, panorama = figure.subplots(2, 1, height_ratios=ratios)
        _draw_scan_plan(plan, points_lidar, lines, window)
        _draw_panorama(panorama, points_lidar, lines)
        return to_png(figure)


def draw_registration(
    clouds: TwoClouds,
    lines: tuple[LineSet, LineSet],
    matches: Int64[np.ndarray, "M 2"],
    T_target_source: Transform | None,
    title: str,
) -> bytes:
    """Return a PNG: two scans (source, target) as they came and, where found, brought together.

    The first plan lays both in one frame as if nothing had moved and joins the matched lines.
    Points near the ground are left out.
    """
    with picture_style():
        found = T_target_source is not None
        window = _window(clouds[1])
        width = PAGE_IN if found else 0.6 * PAGE_IN
        height = (0.5 if found else 0.6) * PAGE_IN * _height_to_width(window) + 1.0
        figure = new_figure(width, height, title)
        plans = figure.subplots(1, 2 if found else 1, squeeze=False)[0]
        _draw_both(plans[0], clouds, lines, np.eye(4))
        first, second = (line_places(lines[side])[matches[:, side]] for side in (0, 1))
        draw_pairs(plans[0], first, second, colors=GREEN, linewidths=0.9, zorder=6)
        plans[0].plot([], [], color=GREEN, label=f"matched lines ({len(matches)})")
        plans[0].set_title("as they came")
        if T_target_source is not None:
            _draw_both(plans[1], clouds, lines, T_target_source)
            plans[1].set_title("source moved by T_target_source")
        for plan in plans:
            show_window(plan, window)
            plan.legend(loc="upper right", framealpha=0.9)
        return to_png(figure)


def _draw_both(
    axes: Any,
    clouds: TwoClouds,
    lines: tuple[LineSet, LineSet],
    T_target_source: Transform,
) -> None:
    source = transform_points(T_target_source, clouds[0])
    for points, colour, name in ((clouds[1], VERMILION, "target"), (source, BLUE, "source")):
        high = points[height_shade(points[:, 2]) > GROUND_SHADE]
        axes.scatter(high[:, 0], high[:, 1], s=0.8, lw=0, c=colour, alpha=0.4, rasterized=True)
        axes.plot([], [], "s", color=colour, label=name)
    source_lines = lines[0].transformed(T_target_source)
    for line_set, colour in ((lines[1], VERMILION), (source_lines, BLUE)):
        at = line_places(line_set)
        axes.scatter(at[:, 0], at[:, 1], s=26, c=colour, ec=BLACK, lw=0.8, zorder=5)
        draw_segments(
            axes, line_set.endpoints[:, :, :2], colors=BLACK, linewidths=1.2, alpha=0.7, zorder=4
        )


def _draw_scan_plan(axes: Any, points: Points, lines: LineSet, window: Window) -> None:
    draw_cloud(axes, points[:, :2], height_shade(points[:, 2]))
    draw_plan_lines(axes, lines)
    axes.plot(0.0, 0.0, "^", ms=9, color=BLACK, label="sensor", zorder=6)
    show_window(axes, window)
    axes.grid(False)
    axes.set_title("from above; darker points stand higher")
    axes.legend(loc="upper right", framealpha=0.9)


def _window(points: Points) -> Window:
    """Return what holds all but the outermost points, at most VIEW_M from the origin."""
    if len(points) == 0:
        return np.full(2, -VIEW_M), np.full(2, VIEW_M)
    low, high = np.percentile(points[:, :2], [1.0, 99.0], axis=0)
    return np.clip(low - 3.0, -VIEW_M, -5.0), np.clip(high + 3.0, 5.0, VIEW_M)


def _draw_panorama(axes: Any, points: Points, lines: LineSet) -> None:
    draw_cloud(axes, to_angles_deg(points), _nearness(points), size=1.6)
    steps = np.linspace(0.0, 1.0, SAMPLES_PER_LINE)[:, None]
    for (start, end), colour in zip(lines.endpoints, kind_colours(lines), strict=True):
        at = to_angles_deg(start + steps * (end - start))
        wraps = np.abs(np.diff(at[:, 0])) > 180.0
        at[:-1][wraps] = np.nan
        axes.plot(at[:, 0], at[:, 1], color=colour, lw=1.8)
    axes.set_xlim(180.0, -180.0)
    axes.set_ylim(*_elevation_limits(points))
    axes.set_xticks(np.arange(-180, 181, 45))
    axes.set_xlabel("azimuth (deg), left positive")
    axes.set_ylabel("elevation (deg)")
    axes.set_title(
        "all around, as the sensor sees it; darker points are nearer, the ground is faint"
    )
    style_axes(axes)
    axes.grid(False)


def to_angles_deg(points_lidar: Points) -> Float64[np.ndarray, "N 2"]:
    """Return (azimuth, elevation) of points as the sensor sees them, in degrees."""
    x, y, z = points_lidar.T
    return np.degrees(np.stack([np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))], axis=1))


def _height_to_width(window: Window) -> float:
    width, height = window[1] - window[0]
    return float(height / width)


def _nearness(points: Points) -> Float64[np.ndarray, "N"]:
    near = np.clip(1.2 - np.linalg.norm(points, axis=1) / 50.0, 0.3, 1.0)
    return np.where(height_shade(points[:, 2]) > GROUND_SHADE, near, 0.0)


def _elevation_limits(points: Points) -> tuple[float, float]:
    """Leave out most of the ground, where no lines are."""
    if len(points) == 0:
        return LOWEST_DEG, 15.0
    low, high = np.percentile(to_angles_deg(points)[:, 1], [0.5, 99.9])
    return max(float(low) - 1.0, LOWEST_DEG), float(high) + 3.0

"""Pictures of ``bench slam``: bars side by side, paths over the truth, time and memory by scan."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float64

from sl3d_slam.bench.slam_process import Answer
from sl3d_slam.bench.tables import Row
from sl3d_slam.geometry.se3 import Points, transform_points
from sl3d_slam.report.metrics import align
from sl3d_slam.report.style import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    VERMILION,
    new_figure,
    picture_style,
    style_axes,
    style_plan,
    to_png,
)

SYSTEM_COLOURS = {"sl3d-slam": BLUE, "kiss-slam": VERMILION, "kiss-icp": ORANGE}
SMOOTH_SCANS = 25
BARS = (
    ("ate_m", "ATE (m)"),
    ("ms_all", "ms per scan, all in"),
    ("ms_p99", "p99 ms"),
    ("peak_rss_mb", "peak memory (MB)"),
)


def colour_of(system: str) -> str:
    """Return the colour of a system in every picture."""
    return SYSTEM_COLOURS.get(system, GREEN)


def draw_bars(rows: Sequence[Row]) -> bytes:
    """Return a PNG with one panel a figure, one group of bars a sequence."""
    sequences = list(dict.fromkeys((row["sequence"], row["kind"]) for row in rows))
    systems = list(dict.fromkeys(row["system"] for row in rows))
    with picture_style():
        width_in = max(11.0, 2.0 + 2.2 * len(sequences))
        figure = new_figure(width_in, 8.0, "SLAM systems side by side")
        for axes, (key, title) in zip(figure.subplots(2, 2).ravel(), BARS, strict=True):
            for place, system in enumerate(systems):
                heights = [_value(rows, sequence, system, key) for sequence in sequences]
                at = np.arange(len(sequences)) + 0.8 * (place + 0.5) / len(systems) - 0.4
                bars = axes.bar(
                    at, heights, 0.75 / len(systems), color=colour_of(system), label=system
                )
                axes.bar_label(bars, [_label(height) for height in heights], fontsize=8)
            names = [f"{name}\n({kind})" for name, kind in sequences]
            axes.set_xticks(range(len(sequences)), names, fontsize=9)
            axes.set_title(title)
            style_axes(axes)
        figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside upper right")
        return to_png(figure)


def _value(rows: Sequence[Row], sequence: tuple[str, str], system: str, key: str) -> float:
    for row in rows:
        if (row["sequence"], row["kind"]) == sequence and row["system"] == system:
            value = row.get(key)
            return float("nan") if value is None else float(value)
    return float("nan")


def _label(height: float) -> str:
    if np.isnan(height):
        return "none"
    return f"{height:.0f}" if height >= 100.0 else f"{height:.3g}"


def draw_paths(
    answers: Mapping[str, Answer], truth: Float64[np.ndarray, "T 4 4"] | None, title: str
) -> bytes:
    """Return a PNG with every trajectory laid on the truth, and its distance from it."""
    with picture_style():
        figure = new_figure(13.0, 6.5, title)
        plan, errors = figure.subplots(1, 2, width_ratios=[1.5, 1.0])
        if truth is not None:
            place = truth[:, :3, 3]
            plan.plot(place[:, 0], place[:, 1], color=BLACK, lw=3.5, alpha=0.35, label="truth")
        for system, answer in answers.items():
            if answer.series is not None:
                _draw_path(plan, errors, system, answer.series.T_world_lidar[:, :3, 3], truth)
        style_plan(plan)
        plan.legend()
        style_axes(errors)
        errors.set_title("distance from the truth")
        errors.set_xlabel("scan")
        errors.set_ylabel("m")
        return to_png(figure)


def _draw_path(
    plan: Any, errors: Any, system: str, path: Points, truth: Float64[np.ndarray, "T 4 4"] | None
) -> None:
    colour = colour_of(system)
    if truth is not None and len(truth) == len(path) and np.isfinite(path).all():
        path = transform_points(align(path, truth[:, :3, 3]), path)
        error_m = np.linalg.norm(path - truth[:, :3, 3], axis=1)
        errors.plot(error_m, color=colour, lw=1.4, label=system)
    plan.plot(path[:, 0], path[:, 1], color=colour, lw=1.4, label=system)


def draw_series(
    answers: Mapping[str, Answer], title: str, colours: Mapping[str, str] = SYSTEM_COLOURS
) -> bytes:
    """Return a PNG with milliseconds (each scan, and a running mean) and memory over the run."""
    with picture_style():
        figure = new_figure(11.0, 7.0, f"{title}: time and memory over the run")
        times, memory = figure.subplots(2, 1, sharex=True)
        for system, answer in answers.items():
            if answer.series is None:
                continue
            colour = colours.get(system, GREEN)
            taken_ms = answer.series.taken_ms
            times.plot(taken_ms, ".", color=colour, ms=1.5, alpha=0.4)
            times.plot(_running_mean(taken_ms), color=colour, lw=1.6, label=system)
            memory.plot(answer.series.resident_mb, color=colour, lw=1.6, label=system)
        times.set_yscale("log")
        times.set_ylabel("ms per scan")
        times.axhline(100.0, color=GREY, lw=0.8, ls=":")
        memory.set_ylabel("resident memory (MB)")
        memory.set_xlabel("scan")
        memory.set_ylim(bottom=0.0)
        for axes in (times, memory):
            style_axes(axes)
        times.legend()
        return to_png(figure)


def _running_mean(values: Float64[np.ndarray, "N"]) -> Float64[np.ndarray, "N"]:
    """Average over the 25 scans around each, fewer at the ends."""
    kernel = np.ones(min(SMOOTH_SCANS, len(values)))
    sums = np.convolve(values, kernel, "same")
    return sums / np.convolve(np.ones(len(values)), kernel, "same")

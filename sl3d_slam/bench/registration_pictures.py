"""Pictures of ``bench registration``: recall by distance, over thresholds, over iterations."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from sl3d_slam.bench.registration_figures import (
    SUCCESS_DEG,
    SUCCESS_M,
    measure,
    recall_curve,
)
from sl3d_slam.bench.registration_methods import Attempt
from sl3d_slam.bench.tables import Row
from sl3d_slam.report.style import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    SKY,
    VERMILION,
    new_figure,
    picture_style,
    style_axes,
    to_png,
)

if TYPE_CHECKING:
    from sl3d_slam.bench.registration_plan import PairGroup

METHOD_COLOURS = {
    "sl3d-slam": BLUE,
    "sl3d-slam, lines alone": SKY,
    "kiss-matcher": VERMILION,
    "fpfh-ransac": ORANGE,
    "fgr": GREEN,
    "icp": GREY,
}


def draw_recall(rows: Sequence[Row], label: str) -> bytes:
    """Return a PNG: recall and time of each method for each group of pairs."""
    known = [
        row for row in rows if row.get("recall_percent") is not None and "@" not in row["method"]
    ]
    groups = list(dict.fromkeys(row["pairs_of"] for row in known))
    methods = list(dict.fromkeys(row["method"] for row in known))
    with picture_style():
        figure = new_figure(12.0, 4.8, f"Registration of two scans{label}")
        panels = figure.subplots(1, 2)
        for axes, key in zip(panels, ("recall_percent", "total_ms"), strict=True):
            for place, method in enumerate(methods):
                heights = [_find(known, group, method, key) for group in groups]
                width = 0.8 / len(methods)
                at = np.arange(len(groups)) + width * (place + 0.5) - 0.4
                colour = METHOD_COLOURS.get(method, PURPLE)
                bars = axes.bar(at, heights, 0.92 * width, color=colour, label=method)
                axes.bar_label(bars, fmt="{:.0f}", fontsize=7)
            axes.set_xticks(range(len(groups)), groups)
            style_axes(axes)
        panels[0].set_title("recall (%), within 2 m and 5 deg")
        panels[1].set_title("time of a pair (ms)")
        panels[1].set_yscale("log")
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=6)
        return to_png(figure)


def draw_curves(
    groups: "Sequence[PairGroup]", answers: Mapping[str, Sequence[Sequence[Attempt]]], label: str
) -> bytes:
    """Return a PNG: recall over the error that is allowed, translation above, rotation below."""
    shown = [(k, group) for k, group in enumerate(groups) if group.name != "different places"]
    allowed_m, allowed_deg = np.linspace(0.0, 3.0, 121), np.linspace(0.0, 6.0, 121)
    with picture_style():
        figure = new_figure(3.4 * len(shown) + 1.5, 6.5, f"Recall over the error allowed{label}")
        panels = figure.subplots(2, len(shown), sharey=True, squeeze=False)
        for column, (k, group) in enumerate(shown):
            truths = [pair.truth for pair in group.pairs if pair.truth is not None]
            for method, attempts in answers.items():
                if "@" in method:
                    continue
                errors = measure(attempts[k], truths[: len(attempts[k])])
                style = {"color": METHOD_COLOURS.get(method, PURPLE), "label": method}
                turned_right = errors.rre_deg <= SUCCESS_DEG
                metres = recall_curve(errors.rte_m, turned_right, allowed_m)
                panels[0, column].plot(allowed_m, metres, **style)
                degrees = recall_curve(errors.rre_deg, errors.rte_m <= SUCCESS_M, allowed_deg)
                panels[1, column].plot(allowed_deg, degrees, **style)
            panels[0, column].set_title(f"{group.name} (n = {len(group.pairs)})")
            panels[0, column].set_xlabel("m, within 5 deg")
            panels[1, column].set_xlabel("deg, within 2 m")
        for axes in panels.ravel():
            style_axes(axes)
            axes.set_ylim(0.0, 102.0)
        panels[0, 0].set_ylabel("recall (%)")
        panels[1, 0].set_ylabel("recall (%)")
        figure.legend(
            *panels[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3
        )
        return to_png(figure)


def draw_iterations(rows: Sequence[Row], label: str) -> bytes:
    """Return a PNG: recall of RANSAC over its iterations; without any, ours is a dashed line."""
    known = [row for row in rows if row.get("recall_percent") is not None]
    groups = list(dict.fromkeys(row["pairs_of"] for row in known))
    colours = [BLUE, VERMILION, GREEN, ORANGE, PURPLE, GREY]
    with picture_style():
        figure = new_figure(7.5, 4.8, f"RANSAC's iterations{label}")
        axes = figure.subplots()
        for k, group in enumerate(groups):
            points = sorted(
                (int(row["method"].partition("@")[2]), row["recall_percent"])
                for row in known
                if row["pairs_of"] == group and "@" in row["method"]
            )
            colour = colours[k % len(colours)]
            axes.plot(*zip(*points, strict=True), marker="o", color=colour, label=f"FPFH, {group}")
            level = _find(known, group, "sl3d-slam", "recall_percent")
            axes.axhline(level, color=colour, ls="--", label=f"sl3d-slam (none), {group}")
        axes.set_xscale("log")
        axes.set_xlabel("iterations")
        axes.set_ylabel("recall (%)")
        axes.set_ylim(0.0, 102.0)
        style_axes(axes)
        axes.legend(fontsize=8)
        return to_png(figure)


def _find(rows: Sequence[Row], group: str, method: str, key: str) -> float:
    for row in rows:
        if row["pairs_of"] == group and row["method"] == method:
            return float(row[key])
    return float("nan")

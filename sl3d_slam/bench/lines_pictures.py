"""The picture of ``bench lines``: each figure over distance, a colour a method, with its spread."""

from collections.abc import Sequence
from typing import Any

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

COLOURS = (GREY, BLUE, VERMILION, GREEN, ORANGE, PURPLE, SKY)
PANELS = (
    ("repeat", "found again (%)"),
    ("top", "true partner in the top five (%), chance dotted"),
    ("registered", "registered (%), by lines alone dashed"),
)


def draw_lines_bench(rows: Sequence[Row]) -> bytes:
    """Return a PNG: one row of panels for each drive and for drives together."""
    shown = [row for row in rows if row["status"] == "ok"]
    drives = list(dict.fromkeys((row["drives"], row["kind"]) for row in shown))
    methods = list(dict.fromkeys(row["method"] for row in shown))
    with picture_style():
        figure = new_figure(13.0, 3.2 * max(len(drives), 1) + 0.8, "Line extractors")
        panels = figure.subplots(max(len(drives), 1), len(PANELS), squeeze=False)
        for line, (drive, kind) in zip(panels, drives, strict=False):
            for axes, (key, title) in zip(line, PANELS, strict=True):
                for colour, method in zip(COLOURS * len(methods), methods, strict=False):
                    own = [
                        row
                        for row in shown
                        if (row["drives"], row["kind"], row["method"]) == (drive, kind, method)
                    ]
                    _draw_series(axes, own, key, colour, method)
                axes.set_title(f"{drive} ({kind}): {title}", fontsize=9)
                axes.set_ylim(0.0, 105.0)
                style_axes(axes)
        for axes in panels[-1]:
            axes.set_xlabel("metres apart")
        handles, labels = panels[0][0].get_legend_handles_labels()
        if handles:
            figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))
        return to_png(figure)


def _draw_series(axes: Any, rows: Sequence[Row], key: str, colour: str, method: str) -> None:
    known = [row for row in rows if row[f"{key}_percent"] is not None]
    at = [float(row["distance"].removesuffix(" m")) for row in known]
    values = [row[f"{key}_percent"] for row in known]
    spreads = [row[f"{key}_spread"] for row in known]
    axes.errorbar(at, values, spreads, color=colour, marker="o", ms=4, capsize=3, label=method)
    beside = {"top": ("chance_top", ":"), "registered": ("registered_alone", "--")}.get(key)
    if beside is not None:
        second = [row[f"{beside[0]}_percent"] for row in known]
        axes.plot(at, second, color=colour, ls=beside[1], lw=1.0)

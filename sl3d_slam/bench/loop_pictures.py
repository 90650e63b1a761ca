"""The picture of ``bench loops``: precision over recall."""

from collections.abc import Mapping

from sl3d_slam.bench.loop_figures import DIRECTIONS, Curve
from sl3d_slam.report.style import (
    BLUE,
    PURPLE,
    VERMILION,
    new_figure,
    picture_style,
    style_axes,
    to_png,
)

COLOURS = {"sl3d-slam": BLUE, "map-closures": VERMILION}


def draw_curves(curves: Mapping[str, Mapping[str, Curve]], title: str) -> bytes:
    """Return a PNG with one panel a direction; a ring marks each detector's own threshold."""
    with picture_style():
        figure = new_figure(13.0, 4.8, title)
        panels = figure.subplots(1, len(DIRECTIONS), sharey=True)
        for axes, direction in zip(panels, DIRECTIONS, strict=True):
            count = 0
            for detector, by_direction in curves.items():
                found = by_direction[direction]
                count = found.num_revisits
                colour = COLOURS.get(detector, PURPLE)
                recall, precision = 100.0 * found.recall, 100.0 * found.precision
                axes.plot(recall, precision, ".-", color=colour, label=detector)
                if found.own[0] is not None:
                    own = 100.0 * found.own[1], 100.0 * found.own[0]
                    axes.plot(*own, "o", ms=11, mfc="none", mec=colour)
            axes.set_title(f"{direction} ({count} revisiting scans)")
            axes.set_xlabel("recall (%)")
            axes.set_xlim(-2.0, 102.0)
            axes.set_ylim(-2.0, 104.0)
            style_axes(axes)
        panels[0].set_ylabel("precision (%)")
        panels[0].legend(loc="lower left")
        return to_png(figure)

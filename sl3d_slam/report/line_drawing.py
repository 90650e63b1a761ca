"""How lines are drawn from above: standing ones as dots sized by height, others as segments."""

from typing import Any

import numpy as np
from jaxtyping import Bool, Float64

from sl3d_slam.geometry.segments import Segments, directions, midpoints
from sl3d_slam.report.style import KIND_COLOURS, KIND_NAMES, Plane, draw_segments
from sl3d_slam.types import LineKind, LineSet

STANDING_SINE = 0.8
DOT_AREA_PER_M = 6.0
SMALLEST_DOT = 8.0


def draw_plan_lines(axes: Any, lines: LineSet, label: bool = True) -> None:
    """Draw lines from above, coloured by kind, with one legend entry for each kind present."""
    for kind in KIND_COLOURS:
        chosen = lines.take(lines.kinds == kind)
        if len(chosen) == 0:
            continue
        name = f"{KIND_NAMES[kind]} ({len(chosen)})" if label else None
        _draw_kind(axes, chosen.endpoints, KIND_COLOURS[kind], name)


def is_standing(endpoints: Segments) -> Bool[np.ndarray, "L"]:
    """Tell which segments are within 37 degrees of the vertical."""
    return np.abs(directions(endpoints)[:, 2]) > STANDING_SINE


def draw_pairs(axes: Any, first: Plane, second: Plane, **style: Any) -> None:
    """Join the middles of matched lines."""
    draw_segments(axes, np.stack([first, second], axis=1), **style)


def line_places(lines: LineSet) -> Plane:
    """Return where lines are in the plane: their middles, without height."""
    return midpoints(lines.endpoints)[:, :2]


def kind_colours(lines: LineSet) -> list[str]:
    """Return one colour a line."""
    return [KIND_COLOURS[LineKind(int(kind))] for kind in lines.kinds]


def _draw_kind(axes: Any, endpoints: Segments, colour: str, label: str | None) -> None:
    standing = is_standing(endpoints)
    lying = endpoints[~standing][:, :, :2]
    draw_segments(axes, lying, colors=colour, linewidths=1.8, zorder=3)
    at = midpoints(endpoints[standing])
    area = SMALLEST_DOT + DOT_AREA_PER_M * _heights_m(endpoints[standing])
    axes.scatter(at[:, 0], at[:, 1], s=area, c=colour, alpha=0.8, lw=0.4, ec="white", zorder=4)
    if label:
        marks = {"marker": "o" if standing.any() else "", "ls": "-" if len(lying) else ""}
        axes.plot([], [], color=colour, lw=1.8, ms=6, label=label, **marks)


def _heights_m(endpoints: Segments) -> Float64[np.ndarray, "L"]:
    return np.abs(endpoints[:, 1, 2] - endpoints[:, 0, 2])

"""What all pictures share: colours that colour-blind readers tell apart, axes, PNG bytes."""

from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from typing import Any

import numpy as np
from jaxtyping import Float64, Shaped

from sl3d_slam.types import LineKind

# Okabe and Ito's palette (jfly.uni-koeln.de/color), told apart with any colour vision.
BLACK, GREY = "#000000", "#8a8a8a"
BLUE, SKY, GREEN = "#0072B2", "#56B4E9", "#009E73"
ORANGE, VERMILION, PURPLE = "#E69F00", "#D55E00", "#CC79A7"

KIND_COLOURS = {
    LineKind.POLE: VERMILION,
    LineKind.VERTICAL_EDGE: BLUE,
    LineKind.OTHER_EDGE: GREEN,
    LineKind.UNKNOWN: GREY,
}
KIND_NAMES = {
    LineKind.POLE: "pole",
    LineKind.VERTICAL_EDGE: "standing edge",
    LineKind.OTHER_EDGE: "other edge",
    LineKind.UNKNOWN: "kind unknown",
}
DPI = 130
FONTS: Any = {"font.size": 10.0, "axes.titlesize": 11.0}

Plane = Float64[np.ndarray, "N 2"]
Window = tuple[Float64[np.ndarray, "2"], Float64[np.ndarray, "2"]]  # lower left, upper right


@contextmanager
def picture_style() -> Iterator[None]:
    """Draw with these fonts and matplotlib's defaults, whatever the user's own style says."""
    from matplotlib import style

    with style.context(["default", FONTS]):
        yield


def colour_of(index: int) -> Any:
    """Return one of twenty colours for things that have no colour of their own."""
    from matplotlib import colormaps

    return colormaps["tab20"](index % 20)


def new_figure(width_in: float, height_in: float, title: str) -> Any:
    """Return an empty figure with a title, drawn off screen and known to no global state."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width_in, height_in), layout="constrained", facecolor="white")
    if title:
        figure.suptitle(title, fontsize=13, fontweight="bold")
    return figure


def to_png(figure: Any) -> bytes:
    """Return the figure as the bytes of a PNG file."""
    buffer = BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI)
    return buffer.getvalue()


def page_size(extent_m: Float64[np.ndarray, "2"], long_in: float = 9.0) -> tuple[float, float]:
    """Return (width, height) in inches that suits an area, never slimmer than 1 to 2."""
    width, height = np.maximum(extent_m, extent_m.max() / 2.0) / max(extent_m.max(), 1e-6)
    return long_in * float(width), long_in * float(height)


def show_window(axes: Any, window: Window) -> None:
    """Make axes a plan of the rectangle between two corners, with a scale bar."""
    low, high = window
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    style_plan(axes)
    draw_scale_bar(axes)


def style_plan(axes: Any) -> None:
    """Make axes a plan seen from above: one metre is as long along x as along y."""
    axes.set_aspect("equal", adjustable="datalim" if axes.get_autoscale_on() else "box")
    axes.set_xlabel("x (m)")
    axes.set_ylabel("y (m)")
    style_axes(axes)


def style_axes(axes: Any) -> None:
    """Draw a light grid behind everything and no box on the right and on top."""
    axes.grid(True, color="#e6e6e6", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def draw_scale_bar(axes: Any) -> None:
    """Draw a bar of 1, 2 or 5 times a power of ten metres, about a fifth of the plan's width."""
    left, right = axes.get_xlim()
    length_m = nice_length((right - left) / 5.0)
    transform = axes.get_xaxis_transform()
    start = left + 0.04 * (right - left)
    axes.plot(
        [start, start + length_m], [0.035] * 2, color=BLACK, lw=3, transform=transform, zorder=9
    )
    axes.text(
        start + length_m / 2,
        0.045,
        f"{length_m:g} m",
        transform=transform,
        ha="center",
        va="bottom",
    )
    axes.set_xlim(left, right)


def nice_length(length: float) -> float:
    """Return the largest of 1, 2, 5 times a power of ten that is not above ``length``."""
    power = 10.0 ** np.floor(np.log10(length))
    return float(max(step * power for step in (1.0, 2.0, 5.0) if step * power <= length * 1.000001))


def draw_segments(axes: Any, ends: Float64[np.ndarray, "L 2 2"], **style: Any) -> None:
    """Draw segments of the plane, one colour and width for all."""
    from matplotlib.collections import LineCollection

    axes.add_collection(LineCollection(list(ends), **style), autolim=True)


def draw_cloud(axes: Any, at: Plane, shade: Shaped[np.ndarray, "N"], size: float = 0.8) -> None:
    """Draw many points small; ``shade`` runs from 0 (faint) to 1 (dark grey)."""
    order = np.argsort(shade)
    axes.scatter(
        at[order, 0],
        at[order, 1],
        c=0.12 + 0.63 * shade[order],
        s=size,
        lw=0,
        cmap="Greys",
        vmin=0.0,
        vmax=1.0,
        rasterized=True,
    )


def height_shade(heights_m: Float64[np.ndarray, "N"]) -> Float64[np.ndarray, "N"]:
    """Shade points by height, so that what stands is dark and the ground faint."""
    if len(heights_m) == 0:
        return heights_m
    low = float(np.percentile(heights_m, 20))
    return np.clip((heights_m - low) / 5.0, 0.0, 1.0)

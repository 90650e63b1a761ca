"""The picture of ``bench scale``."""

from typing import TYPE_CHECKING

from sl3d_slam.report.style import (
    BLUE,
    GREEN,
    ORANGE,
    VERMILION,
    new_figure,
    picture_style,
    to_png,
)

if TYPE_CHECKING:
    from sl3d_slam.bench.scale import ScaleRow

COLOURS = (BLUE, GREEN, ORANGE, VERMILION)


def draw_scales(rows: "list[ScaleRow]") -> bytes:
    """Draw accuracy and mean IoU over the scale of the test clouds; return a PNG."""
    methods = list(dict.fromkeys(row.method for row in rows))
    with picture_style():
        figure = new_figure(11.0, 4.5, "Line segmentation when the world is scaled (simulated)")
        panels = (("accuracy", "accuracy"), ("mean_iou", "mean IoU"))
        for axes, (key, title) in zip(figure.subplots(1, 2), panels, strict=True):
            for method, colour in zip(methods, COLOURS, strict=True):
                chosen = [row for row in rows if row.method == method]
                scales = [row.scale for row in chosen]
                values = [getattr(row, key) for row in chosen]
                axes.plot(scales, values, marker="o", ms=4, color=colour, label=method)
            axes.axvline(1.0, color="#c8c8c8", lw=1.0, zorder=0)
            axes.set_xlabel("scale of the test clouds; 1 is the scale of training")
            axes.set_ylabel(title)
            axes.grid(alpha=0.3)
        figure.axes[0].legend(fontsize=8)
        return to_png(figure)

"""Pictures of ``bench backend``."""

from collections.abc import Sequence

from sl3d_slam.bench.tables import Row
from sl3d_slam.report.style import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    SKY,
    VERMILION,
    new_figure,
    picture_style,
    to_png,
)

COLOURS = {
    "oracle": BLACK,
    "ours": VERMILION,
    "ours, live": ORANGE,
    "LM": GREY,
    "Huber": SKY,
    "Cauchy": BLUE,
    "DCS": GREEN,
    "GNC, all poses": PURPLE,
}

GROWTH_CURVES = (
    ("median_ms", "median", BLUE),
    ("p90_ms", "nine of ten", GREEN),
    ("p99_ms", "99 of 100", ORANGE),
    ("max_ms", "worst", VERMILION),
)


def draw_results(rows: Sequence[Row]) -> bytes:
    """Draw ATE over the share of false loops, one panel a kind; return a PNG."""
    kinds = list(dict.fromkeys(row["kind"] for row in rows))
    with picture_style():
        figure = new_figure(6.0 * len(kinds), 4.5, "Trajectory error with false loops (simulated)")
        for axes, kind in zip(figure.subplots(1, len(kinds), sharey=True), kinds, strict=True):
            for method, colour in COLOURS.items():
                chosen = [row for row in rows if row["kind"] == kind and row["method"] == method]
                shares = [100.0 * row["share_false"] for row in chosen]
                errors_m = [row["ate_m"] for row in chosen]
                dashes = "--" if method == "oracle" else "-"
                axes.plot(shares, errors_m, dashes, marker="o", color=colour, label=method)
            axes.axhline(rows[0]["odometry_ate_m"], color=ORANGE, linestyle=":", label="odometry")
            axes.set_yscale("log")
            axes.set_xlabel("false loops, %")
            axes.set_title(f"{kind} false loops")
            axes.grid(alpha=0.3)
        figure.axes[0].set_ylabel("ATE, m")
        figure.axes[-1].legend(fontsize=8)
        return to_png(figure)


def draw_growth(rows: Sequence[Row]) -> bytes:
    """Draw the time of an update over the size of the graph; return a PNG."""
    with picture_style():
        figure = new_figure(6.0, 4.0, "Time per keyframe as the graph grows")
        axes = figure.subplots()
        sizes = [row["num_keyframes"] for row in rows]
        for key, label, colour in GROWTH_CURVES:
            taken_ms = [row[key] for row in rows]
            axes.plot(sizes, taken_ms, marker="o", color=colour, label=label)
        axes.set_yscale("log")
        axes.set_xlabel("keyframes")
        axes.set_ylabel("ms")
        axes.grid(alpha=0.3)
        axes.legend()
        return to_png(figure)

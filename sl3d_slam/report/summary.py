"""The table at the end of a run."""

from collections.abc import Mapping
from typing import Any

from rich.table import Table

ROWS: tuple[tuple[str, str, str], ...] = (
    ("num_scans", "scans", "{:d}"),
    ("num_keyframes", "keyframes", "{:d}"),
    ("length_m", "distance travelled", "{:.0f} m"),
    ("ate_rmse_m", "error against the truth (ATE)", "{:.2f} m"),
    ("odometry_ate_rmse_m", "... of odometry alone", "{:.2f} m"),
    ("kitti_translation_percent", "KITTI translation error", "{:.2f} %"),
    ("kitti_rotation_deg_per_m", "KITTI rotation error", "{:.4f} deg/m"),
    ("loops_accepted", "loops accepted", "{:d}"),
    ("loops_false", "... of which false", "{:d}"),
    ("loops_rejected", "loops rejected", "{:d}"),
    ("loops_revoked", "loops revoked", "{:d}"),
    ("num_lines", "lines in the map", "{:d}"),
    ("map_kb_per_km", "size of the line map", "{:.0f} kB/km"),
    ("peak_rss_mb", "peak memory", "{:.0f} MB"),
    ("wall_s", "time in all", "{:.1f} s"),
    ("scans_per_s", "speed", "{:.1f} scans/s"),
)


def summary_table(metrics: Mapping[str, Any], title: str = "") -> Table:
    """Lay out the content of ``metrics.json``; what is absent or null there gets no row.

    ``metrics["stages"]`` maps the name of a stage to its ``mean_ms`` and ``p99_ms``.
    """
    table = Table(title=title or None, show_header=False, title_justify="left")
    table.add_column(style="bold")
    table.add_column(justify="right")
    for key, name, form in ROWS:
        if metrics.get(key) is not None:
            table.add_row(name, form.format(metrics[key]))
    stages: Mapping[str, Mapping[str, float]] = metrics.get("stages", {})
    if stages:
        table.add_section()
    for name, times in stages.items():
        table.add_row(name, f"{times['mean_ms']:.1f} ms, 99 % below {times['p99_ms']:.1f} ms")
    return table

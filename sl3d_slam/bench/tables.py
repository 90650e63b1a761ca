"""What every benchmark leaves: tables as CSV, Markdown and PNG, and how they were made."""

import csv
import io
import os
import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from rich.markup import escape
from rich.table import Table as RichTable

from sl3d_slam import __version__
from sl3d_slam.bench.peers import installed_peers
from sl3d_slam.files import write_whole
from sl3d_slam.report.style import new_figure, picture_style, to_png

Row = Mapping[str, Any]
EMPTY = "-"


@dataclass(frozen=True, slots=True)
class Column:
    """A column that people read: the key of the row, a heading, how a number is written.

    Those that are not ``main`` are left out on a terminal that is too narrow.
    """

    key: str
    title: str
    form: str = "{}"
    main: bool = True


@dataclass(frozen=True, slots=True)
class Table:
    """Rows of figures; the CSV file gets every key of the rows, the others these columns."""

    title: str
    columns: Sequence[Column]
    rows: Sequence[Row]
    notes: Sequence[str] = ()


def write_tables(out: Path, name: str, tables: Sequence[Table], command: str = "") -> None:
    """Write ``NAME.md`` with all tables and, for the first, ``NAME.csv`` and ``NAME_table.png``.

    Further tables go to ``NAME_2.csv`` and so on. Raises OutputError where ``out`` cannot be
    written.
    """
    parts = [to_markdown(table) for table in tables]
    write_whole(out / f"{name}.md", "\n".join([*parts, _provenance(command)]))
    for number, table in enumerate(tables, 1):
        suffix = "" if number == 1 else f"_{number}"
        write_whole(out / f"{name}{suffix}.csv", to_csv(table))
    write_whole(out / f"{name}_table.png", draw_table(tables[0]))


def to_csv(table: Table) -> str:
    """Return every key of every row as CSV; absent values are empty."""
    keys = list(dict.fromkeys(key for row in table.rows for key in row))
    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, keys, restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(table.rows)
    return buffer.getvalue()


def to_markdown(table: Table) -> str:
    """Return a heading, the table and its notes as Markdown."""
    lines = [
        f"## {table.title}",
        "",
        "| " + " | ".join(column.title for column in table.columns) + " |",
        "|" + "---|" * len(table.columns),
    ]
    for cells in _cells(table):
        lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    lines += ["", *(f"- {note}" for note in table.notes), ""]
    return "\n".join(lines)


def to_rich(table: Table, width: int) -> RichTable:
    """Return the table for a terminal of ``width`` characters, with its main columns at least."""
    if _needed_width(table) > width:
        main = [column for column in table.columns if column.main]
        table = Table(table.title, main, table.rows)
    shown = RichTable(title=table.title, title_justify="left")
    for column in table.columns:
        shown.add_column(column.title, justify="left" if column.form == "{}" else "right")
    for cells in _cells(table):
        shown.add_row(*map(escape, cells))
    return shown


def _needed_width(table: Table) -> int:
    titles = [column.title for column in table.columns]
    return 1 + sum(max(map(len, cells)) + 3 for cells in zip(titles, *_cells(table), strict=True))


def draw_table(table: Table) -> bytes:
    """Return the table as a PNG."""
    with picture_style():
        cells = _cells(table) or [[EMPTY] * len(table.columns)]
        titles = [column.title for column in table.columns]
        widths = [
            max(len(row[k]) for row in [titles, *cells]) + 2 for k in range(len(table.columns))
        ]
        figure = new_figure(0.085 * sum(widths) + 0.4, 0.3 * len(cells) + 1.1, table.title)
        axes = figure.subplots()
        axes.axis("off")
        drawn = axes.table(
            cells,
            colLabels=titles,
            colWidths=[width / sum(widths) for width in widths],
            loc="upper center",
            cellLoc="left",
        )
        drawn.auto_set_font_size(False)
        drawn.set_fontsize(9)
        drawn.scale(1.0, 1.5)
        return to_png(figure)


def machine() -> str:
    """Return processor, cores, load and system as one line; a loaded machine tells no times."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    load = os.getloadavg()[0]
    return f"{_processor()}, {cores} cores in use, load {load:.1f}, {_system()}"


def _system() -> str:
    try:
        return platform.freedesktop_os_release()["PRETTY_NAME"]
    except (OSError, KeyError):  # not Linux
        return platform.platform()


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or "unknown processor"
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()


def _provenance(command: str) -> str:
    date = datetime.now(timezone.utc).strftime("%Y-%m-%d %H:%M UTC")
    made = f"Made by `{command}`" if command else "Made"
    return f"{made} on {date}, sl3d-slam {__version__}; {machine()}; peers: {installed_peers()}.\n"


def _cells(table: Table) -> list[list[str]]:
    return [
        [_cell(row.get(column.key), column.form) for column in table.columns] for row in table.rows
    ]


def _cell(value: Any, form: str) -> str:
    return EMPTY if value is None else form.format(value)

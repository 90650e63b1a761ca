"""What ``sl3d info`` prints of a line map."""

from json import dumps
from pathlib import Path

import typer


def show_map(path: Path, as_json: bool) -> None:
    """Print the facts of a map file, a line each, or all as JSON."""
    from sl3d_slam.mapping.facts import map_facts
    from sl3d_slam.mapping.line_map import LineMap

    facts = map_facts(LineMap.load(path))
    if as_json:
        typer.echo(dumps(facts, indent=2))
        return
    for name, value in facts.items():
        typer.echo(f"{name.replace('_', ' ')}: {_plain(value)}")


def _plain(value: object) -> str:
    match value:
        case None:
            return "none"
        case bool():
            return "yes" if value else "no"
        case float():
            return f"{value:.4g}"
        case dict():
            return ", ".join(f"{count} {name}" for name, count in value.items() if count) or "none"
    return str(value)

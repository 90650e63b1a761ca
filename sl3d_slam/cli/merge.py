"""``sl3d merge``: two sessions in one map, aligned by finding places of one in the other."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sl3d_slam.cli.options import ConfigOption, JsonOption, QuietOption, SetOption

if TYPE_CHECKING:
    from sl3d_slam.relocalization.merging import Merged


def merge(
    first: Annotated[Path, typer.Argument(metavar="A", help="The map whose frame is kept.")],
    second: Annotated[Path, typer.Argument(metavar="B", help="Another map of streets nearby.")],
    out: Annotated[Path, typer.Option("--out", metavar="C", help="The joined map to write.")],
    json: JsonOption = False,
    config: ConfigOption = None,
    overrides: SetOption = None,
    quiet: QuietOption = False,
) -> None:
    """Join two maps that share some street, in the frame of the first. Status 1 where none is."""
    from sl3d_slam.cli.progress import Meter
    from sl3d_slam.config import load_config
    from sl3d_slam.errors import InputError
    from sl3d_slam.files import prove_writable
    from sl3d_slam.mapping.line_map import LineMap
    from sl3d_slam.relocalization.merging import merge_maps, places_to_ask

    settings = load_config(config, overrides or ())
    prove_writable(out)
    maps = LineMap.load(first), LineMap.load(second)
    try:
        with Meter(len(places_to_ask(maps[1])), "places", quiet or json) as meter:
            merged = merge_maps(*maps, settings, meter.advance)
    except InputError as error:
        raise InputError(f"{first}, {second}: {error}") from None
    if merged.line_map is not None:
        merged.line_map.save(out)
    if json:
        from json import dumps

        typer.echo(dumps(_tree(merged)))
    elif not quiet:
        typer.echo(f"{out}: {sentence(merged)}")
    if merged.line_map is None:
        raise typer.Exit(1)


def sentence(merged: "Merged") -> str:
    """Say what was joined, or why nothing was."""
    if merged.line_map is None:
        return f"not written: {merged.reason}"
    return (
        f"{len(merged.line_map)} landmarks of {len(merged.line_map.T_map_keyframe)} keyframes; "
        f"{merged.num_agreeing} of {merged.num_asked} places of the second map tie it to the first"
    )


def _tree(merged: "Merged") -> dict[str, Any]:
    T_first_second = merged.T_first_second
    return {
        "success": merged.line_map is not None,
        "T_first_second": None if T_first_second is None else T_first_second.tolist(),
        "landmarks": None if merged.line_map is None else len(merged.line_map),
        "places_asked": merged.num_asked,
        "places_found": merged.num_found,
        "places_agreeing": merged.num_agreeing,
        "reason": merged.reason,
    }

"""``sl3d export``: a line map for other programs."""

from pathlib import Path
from typing import Annotated

import typer

from sl3d_slam.cli.options import QuietOption

SUFFIXES = (".ply", ".las", ".geojson")


def export(
    line_map: Annotated[Path, typer.Argument(metavar="MAP", help="A map.sl3d of sl3d map.")],
    out: Annotated[
        Path, typer.Argument(metavar="OUT", help="A file to write: .ply, .las or .geojson.")
    ],
    quiet: QuietOption = False,
) -> None:
    """Write a line map as PLY edges, LAS points or GeoJSON, in local metres."""
    from sl3d_slam.files import prove_writable, write_whole
    from sl3d_slam.mapping.export import geojson_text, las_bytes, ply_bytes
    from sl3d_slam.mapping.line_map import LineMap

    prove_writable(out, SUFFIXES)
    loaded = LineMap.load(line_map)
    match out.suffix.lower():
        case ".ply":
            write_whole(out, ply_bytes(loaded))
        case ".las":
            write_whole(out, las_bytes(loaded))
        case _:
            write_whole(out, geojson_text(loaded))
    if not quiet:
        simulated = " (simulated)" if loaded.simulated else ""
        typer.echo(f"{len(loaded)} landmarks{simulated} -> {out}")

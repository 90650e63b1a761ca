"""``sl3d lines``: the lines of one scan."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sl3d_slam.cli.options import ConfigOption, JsonOption, QuietOption, SetOption

if TYPE_CHECKING:
    import numpy as np

    from sl3d_slam.types import LineSet

SUFFIXES = (".ply", ".json", ".png")


def lines(
    scan: Annotated[Path, typer.Argument(metavar="SCAN", help="A .bin, .pcd or .ply file.")],
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE", help="Write them: .ply, .json or .png.")
    ] = None,
    weights: Annotated[
        Path | None,
        typer.Option("--weights", metavar="FILE", help="Use this network in place of the default."),
    ] = None,
    json: JsonOption = False,
    config: ConfigOption = None,
    overrides: SetOption = None,
    quiet: QuietOption = False,
) -> None:
    """Find the poles and building edges of one scan."""
    from sl3d_slam.cli.progress import COMPILING, notice
    from sl3d_slam.config import load_config
    from sl3d_slam.files import prove_writable
    from sl3d_slam.io.open import read_scan
    from sl3d_slam.lines.extract import LineExtractor

    if out is not None:
        prove_writable(out, SUFFIXES)
    wanted = list(overrides or ())
    if weights is not None:
        wanted += ["lines.method=learned", f"lines.weights={weights}"]
    settings = load_config(config, wanted)
    points_lidar = read_scan(scan, settings.input)
    with notice(COMPILING, lambda: True, quiet or json):
        found = LineExtractor(settings.lines).extract(points_lidar)
    if out is not None:
        _write(out, points_lidar, found, scan.name)
    if json:
        from json import dumps

        typer.echo(dumps(_tree(found)))
    elif not quiet:
        typer.echo(_sentence(found) if out is None else f"{_sentence(found)} -> {out}")


def _write(out: Path, points_lidar: "np.ndarray", found: "LineSet", name: str) -> None:
    from sl3d_slam.files import write_whole
    from sl3d_slam.io.json_files import write_json

    match out.suffix.lower():
        case ".json":
            write_json(out, _tree(found))
        case ".ply":
            write_whole(out, _ply(found))
        case _:
            from sl3d_slam.report.scan_pictures import draw_lines

            write_whole(out, draw_lines(points_lidar, found, f"{name}: {_sentence(found)}"))


def _sentence(found: "LineSet") -> str:
    counts = ", ".join(f"{count} {name}" for name, count in _counts(found).items() if count)
    return f"{len(found)} lines" + (f" ({counts})" if counts else "")


def _counts(found: "LineSet") -> dict[str, int]:
    from sl3d_slam.types import LineKind

    return {kind.name.lower(): int((found.kinds == kind).sum()) for kind in LineKind}


def _tree(found: "LineSet") -> list[dict[str, Any]]:
    """Return one entry a line: end points in metres in the scan's frame, best line first."""
    from sl3d_slam.types import LineKind

    return [
        {
            "endpoints_lidar": found.endpoints[i].round(4).tolist(),
            "kind": LineKind(int(found.kinds[i])).name.lower(),
            "score": round(float(found.scores[i]), 4),
            "num_points": int(found.num_points[i]),
            "descriptor": found.descriptors[i].round(5).astype(float).tolist(),
        }
        for i in range(len(found))
    ]


def _ply(found: "LineSet") -> str:
    """Return an ascii PLY: two vertices and one edge a line, coloured by kind."""
    from sl3d_slam.types import LineKind

    colours = {
        LineKind.UNKNOWN: (128, 128, 128),
        LineKind.POLE: (213, 94, 0),
        LineKind.VERTICAL_EDGE: (0, 114, 178),
        LineKind.OTHER_EDGE: (230, 159, 0),
    }
    header = [
        "ply", "format ascii 1.0", f"element vertex {2 * len(found)}",
        "property float x", "property float y", "property float z",
        "property uchar red", "property uchar green", "property uchar blue",
        f"element edge {len(found)}", "property int vertex1", "property int vertex2",
        "property float score", "end_header",
    ]  # fmt: skip
    vertices = [
        " ".join([*(f"{value:.4f}" for value in point), *map(str, colours[LineKind(int(kind))])])
        for segment, kind in zip(found.endpoints, found.kinds, strict=True)
        for point in segment
    ]
    edges = [f"{2 * i} {2 * i + 1} {score:.4f}" for i, score in enumerate(found.scores)]
    return "\n".join([*header, *vertices, *edges]) + "\n"

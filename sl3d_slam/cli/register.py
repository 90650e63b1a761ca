"""``sl3d register``: where one scan is in the frame of another."""

from pathlib import Path
from typing import Annotated

import typer

from sl3d_slam.cli.options import ConfigOption, JsonOption, SetOption


def register(
    source: Annotated[Path, typer.Argument(metavar="SOURCE", help="A .bin, .pcd or .ply file.")],
    target: Annotated[Path, typer.Argument(metavar="TARGET", help="A .bin, .pcd or .ply file.")],
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE.png", help="Draw both scans and matches.")
    ] = None,
    lines_only: Annotated[bool, typer.Option(help="Decide by lines alone, no clouds.")] = False,
    json: JsonOption = False,
    config: ConfigOption = None,
    overrides: SetOption = None,
) -> None:
    """Find T_target_source of two scans, no first guess. Status 1 where there is no answer."""
    import numpy as np

    from sl3d_slam.config import load_config
    from sl3d_slam.files import write_whole
    from sl3d_slam.io.open import read_scan
    from sl3d_slam.lines.extract import LineExtractor
    from sl3d_slam.registration import register_lines
    from sl3d_slam.side_by_side import side_by_side

    settings = load_config(config, overrides or ())
    clouds = read_scan(source, settings.input), read_scan(target, settings.input)
    found = side_by_side(LineExtractor(settings.lines).extract, *clouds)
    result = register_lines(*found, None if lines_only else clouds, settings.matching)
    if out is not None:
        from sl3d_slam.report.pictures import draw_registration

        title = f"{source.name} in {target.name}"
        picture = draw_registration(clouds, found, result.matches, result.T_target_source, title)
        write_whole(out, picture)
    if json:
        from json import dumps

        T = result.T_target_source
        tree = {
            "success": result.success,
            "T_target_source": None if T is None else T.tolist(),
            "num_inliers": result.num_inliers,
            "matches": result.matches.tolist(),
            "information": result.information.tolist(),
            "reason": result.reason,
        }
        typer.echo(dumps(tree))
    elif result.T_target_source is None:
        typer.echo(f"no answer: {result.reason}")
    else:
        with np.printoptions(precision=4, suppress=True):
            typer.echo(f"{result.num_inliers} lines agree; T_target_source =")
            typer.echo(str(result.T_target_source))
    if not result.success:
        raise typer.Exit(1)

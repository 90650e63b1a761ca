"""``sl3d register``: where one scan is in the frame of another."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sl3d_slam.cli.options import ConfigOption, JsonOption, QuietOption, SetOption

if TYPE_CHECKING:
    from sl3d_slam.types import Registration


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
    quiet: QuietOption = False,
) -> None:
    """Find T_target_source of two scans, no first guess. Status 1 where there is no answer."""
    from sl3d_slam.cli.progress import COMPILING, notice
    from sl3d_slam.config import load_config
    from sl3d_slam.files import prove_writable, write_whole
    from sl3d_slam.io.open import read_scan
    from sl3d_slam.scan_pair import PairRegistrar

    settings = load_config(config, overrides or ())
    if out is not None:
        prove_writable(out, (".png",))
    clouds = read_scan(source, settings.input), read_scan(target, settings.input)
    with notice(COMPILING, lambda: True, quiet or json):
        registrar = PairRegistrar(settings)
        way = registrar.register_by_lines if lines_only else registrar.register
        result, found, _ = way(*clouds)
    if out is not None:
        from sl3d_slam.report.pictures import draw_registration

        title = f"{source.name} in {target.name}"
        picture = draw_registration(clouds, found, result.matches, result.T_target_source, title)
        write_whole(out, picture)
    if json:
        from json import dumps

        typer.echo(dumps(_tree(result)))
    elif not quiet:
        typer.echo(_sentence(result))
    if not result.success:
        raise typer.Exit(1)


def _tree(result: "Registration") -> dict[str, Any]:
    T_target_source = result.T_target_source
    return {
        "success": result.success,
        "T_target_source": None if T_target_source is None else T_target_source.tolist(),
        "num_inliers": result.num_inliers,
        "matches": result.matches.tolist(),
        "information": result.information.tolist(),
        "reason": result.reason,
    }


def _sentence(result: "Registration") -> str:
    import numpy as np

    if result.T_target_source is None:
        return f"no answer: {result.reason}"
    with np.printoptions(precision=4, suppress=True):
        pose = str(result.T_target_source)
    return f"{result.num_inliers} lines agree; T_target_source =\n{pose}"

"""``sl3d relocalize``: the pose of each scan in a saved map, without a first guess."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sl3d_slam.cli.options import ConfigOption, JsonOption, QuietOption, SetOption

if TYPE_CHECKING:
    from sl3d_slam.config import SlamConfig
    from sl3d_slam.mapping.line_map import LineMap
    from sl3d_slam.types import Relocalization

    Answer = tuple[list[Path], Relocalization]


def relocalize(
    line_map: Annotated[Path, typer.Argument(metavar="MAP", help="A map.sl3d of an earlier run.")],
    scans: Annotated[
        list[Path], typer.Argument(metavar="SCAN...", help=".bin, .pcd or .ply files.")
    ],
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="FILE.png", help="Draw the last scan found in the map."),
    ] = None,
    window: Annotated[
        int,
        typer.Option(
            min=1, metavar="N", help="Join N successive scans for each answer, the last one's pose."
        ),
    ] = 1,
    json: JsonOption = False,
    config: ConfigOption = None,
    overrides: SetOption = None,
    quiet: QuietOption = False,
) -> None:
    """Find scans in a saved line map. Status 1 where any of them is not found.

    With --window N, the scans are a drive in order: odometry joins each N of them.
    """
    from sl3d_slam.config import load_config
    from sl3d_slam.files import prove_writable
    from sl3d_slam.mapping.line_map import LineMap

    settings = load_config(config, overrides or ())
    if out is not None:
        prove_writable(out, (".png",))
    loaded = LineMap.load(line_map)
    windows = [scans[start : start + window] for start in range(0, len(scans), window)]
    answers = _ask(line_map, loaded, windows, settings, quiet or json)
    if out is not None:
        _draw(out, line_map, loaded, answers, settings)
    if json:
        from json import dumps

        typer.echo(dumps([_tree(paths, answer) for paths, answer in answers]))
    elif not quiet:
        for paths, answer in answers:
            typer.echo(f"{paths[-1]}: {sentence(answer)}")
    if not all(answer.success for _, answer in answers):
        raise typer.Exit(1)


def _ask(
    path: Path, line_map: "LineMap", windows: list[list[Path]], settings: "SlamConfig", quiet: bool
) -> "list[Answer]":
    from sl3d_slam.cli.progress import COMPILING, Meter, notice
    from sl3d_slam.errors import InputError
    from sl3d_slam.io.open import read_scan
    from sl3d_slam.relocalization.relocalizer import Relocalizer

    try:
        relocalizer = Relocalizer(line_map, settings)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    answers: list[Answer] = []
    with (
        notice(COMPILING, lambda: not answers, quiet),
        Meter(sum(map(len, windows)), quiet=quiet) as meter,
    ):
        for paths in windows:
            points = [read_scan(scan, settings.input) for scan in paths]
            answers.append((paths, relocalizer.relocalize_window(points)))
            meter.advance(steps=len(paths))
    return answers


def _draw(
    out: Path, path: Path, line_map: "LineMap", answers: "list[Answer]", settings: "SlamConfig"
) -> None:
    """Draw the last scan that was found; nothing where none was."""
    from sl3d_slam.files import write_whole
    from sl3d_slam.io.open import read_scan
    from sl3d_slam.report.pictures import draw_relocalization

    for paths, answer in reversed(answers):
        if answer.T_map_lidar is not None:
            scan = paths[-1]
            picture = draw_relocalization(
                line_map.lines,
                line_map.T_map_keyframe,
                read_scan(scan, settings.input),
                answer.T_map_lidar,
                title=f"{scan.name} in {path.name}",
            )
            write_whole(out, picture)
            return


def sentence(answer: "Relocalization") -> str:
    """Say where a scan is, or why that is not known."""
    import numpy as np

    if answer.T_map_lidar is None:
        return f"not found: {answer.reason}"
    x, y, z = answer.T_map_lidar[:3, 3]
    yaw_deg = np.degrees(np.arctan2(answer.T_map_lidar[1, 0], answer.T_map_lidar[0, 0]))
    return (
        f"x {x:.2f} m, y {y:.2f} m, z {z:.2f} m, yaw {yaw_deg:.1f} deg "
        f"({answer.num_inliers} lines, confidence {answer.confidence:.2f})"
    )


def _tree(paths: list[Path], answer: "Relocalization") -> dict[str, Any]:
    T_map_lidar = answer.T_map_lidar
    return {
        "scan": str(paths[-1]),
        "window": [str(path) for path in paths],
        "success": answer.success,
        "T_map_lidar": None if T_map_lidar is None else T_map_lidar.tolist(),
        "information": answer.information.tolist(),
        "num_inliers": answer.num_inliers,
        "confidence": answer.confidence,
        "reason": answer.reason,
    }

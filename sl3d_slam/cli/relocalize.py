"""``sl3d relocalize``: the pose of each scan in a saved map, without a first guess."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sl3d_slam.cli.options import ConfigOption, JsonOption, QuietOption, SetOption

if TYPE_CHECKING:
    from sl3d_slam.types import Relocalization


def relocalize(
    line_map: Annotated[Path, typer.Argument(metavar="MAP", help="A map.sl3d of an earlier run.")],
    scans: Annotated[
        list[Path], typer.Argument(metavar="SCAN...", help=".bin, .pcd or .ply files.")
    ],
    json: JsonOption = False,
    config: ConfigOption = None,
    overrides: SetOption = None,
    quiet: QuietOption = False,
) -> None:
    """Find scans in a saved line map. Status 1 where any of them is not found."""
    from sl3d_slam.cli.progress import Meter
    from sl3d_slam.config import load_config
    from sl3d_slam.errors import InputError
    from sl3d_slam.io.open import read_scan
    from sl3d_slam.mapping.line_map import LineMap
    from sl3d_slam.relocalizer import Relocalizer

    settings = load_config(config, overrides or ())
    loaded = LineMap.load(line_map)
    try:
        relocalizer = Relocalizer(loaded, settings)
    except InputError as error:
        raise InputError(f"{line_map}: {error}") from None
    answers = []
    with Meter(len(scans), quiet=quiet or json) as meter:
        for path in scans:
            answers.append(relocalizer.relocalize(read_scan(path, settings.input)))
            meter.advance()
    if json:
        from json import dumps

        typer.echo(
            dumps([_tree(path, answer) for path, answer in zip(scans, answers, strict=True)])
        )
    elif not quiet:
        for path, answer in zip(scans, answers, strict=True):
            typer.echo(f"{path}: {sentence(answer)}")
    if not all(answer.success for answer in answers):
        raise typer.Exit(1)


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


def _tree(path: Path, answer: "Relocalization") -> dict[str, Any]:
    T_map_lidar = answer.T_map_lidar
    return {
        "scan": str(path),
        "success": answer.success,
        "T_map_lidar": None if T_map_lidar is None else T_map_lidar.tolist(),
        "information": answer.information.tolist(),
        "num_inliers": answer.num_inliers,
        "confidence": answer.confidence,
        "reason": answer.reason,
    }

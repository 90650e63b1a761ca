"""JSON files: numpy values allowed, NaN and infinity refused, written whole."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from sl3d_slam.errors import OutputError
from sl3d_slam.files import write_whole


def write_json(path: Path, tree: Any) -> None:
    """Write a tree of dicts, lists, numbers and texts as indented UTF-8 JSON.

    Raises
    ------
    OutputError
        where the file cannot be written, or the tree holds NaN, infinity or an unknown type.
    """
    try:
        text = json.dumps(tree, indent=2, allow_nan=False, ensure_ascii=False, default=_plain)
    except (ValueError, TypeError) as error:
        raise OutputError(f"{path}: cannot be written as JSON ({error})") from None
    write_whole(path, text + "\n")


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"a {type(value).__name__} has no JSON form")

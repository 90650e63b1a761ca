"""A weights file: safetensors that say what network they belong to; read without torch."""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError
from safetensors import SafetensorError
from safetensors.numpy import load as load_tensors

from sl3d_slam.errors import InputError
from sl3d_slam.lines.network.settings import NetworkSettings
from sl3d_slam.lines.network.shapes import expected_shapes

FORMAT = "sl3d_slam line network 2"
MAX_BYTES = 2_000_000
EXPECTED = "expected weights written by sl3d train"

Tensors = Mapping[str, np.ndarray]


def read_weights(path: Path | str) -> tuple[NetworkSettings, Tensors]:
    """Return the settings of a weights file and its tensors (float32, by name).

    Raises
    ------
    InputError
        where the file is missing, larger than 2 MB, damaged, of another program, or does not hold
        exactly the finite tensors that its settings ask for.
    """
    path = Path(path)
    raw = _read(path)
    settings = _settings(path, read_about(path))
    try:
        tensors = load_tensors(raw)
    except (SafetensorError, KeyError, AttributeError, TypeError) as error:  # or an unknown type
        raise InputError(f"{path}: damaged ({error}); {EXPECTED}") from None
    _check_tensors(path, tensors, expected_shapes(settings))
    return settings, tensors


def read_about(path: Path | str) -> dict[str, str]:
    """Return the header of a weights file: ``format``, ``settings`` and the ``about.`` entries."""
    path = Path(path)
    raw = _read(path)
    size = int.from_bytes(raw[:8], "little")
    try:
        if not 2 <= size <= len(raw) - 8:
            raise ValueError
        header = json.loads(raw[8 : 8 + size])["__metadata__"]
        if header["format"] != FORMAT:
            raise ValueError
    except (ValueError, KeyError, TypeError, RecursionError):
        raise InputError(f"{path}: not a line network's weights; {EXPECTED}") from None
    return {str(key): str(value) for key, value in header.items()}


def hash_of(settings: NetworkSettings, tensors: Tensors) -> str:
    """Return eight hexadecimal digits that stand for a model: its settings and every weight."""
    newer = None if settings.surroundings else {"surroundings"}  # models before it keep their names
    digest = hashlib.sha256(settings.model_dump_json(exclude=newer).encode())
    for name in sorted(tensors):
        digest.update(name.encode() + tensors[name].tobytes())
    return digest.hexdigest()[:8]


def _read(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            raw = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise InputError(f"{path}: cannot be read as weights ({error.strerror})") from None
    if len(raw) > MAX_BYTES:
        raise InputError(f"{path}: larger than {MAX_BYTES} bytes; {EXPECTED}")
    return raw


def _settings(path: Path, header: Mapping[str, str]) -> NetworkSettings:
    try:
        return NetworkSettings.model_validate_json(header.get("settings", ""))
    except ValidationError as error:
        problem: Any = error.errors()[0]
        key = ".".join(str(part) for part in problem["loc"]) or "settings"
        raise InputError(f"{path}: {key} of the network: {problem['msg']}; {EXPECTED}") from None


def _check_tensors(path: Path, found: Tensors, needed: Mapping[str, tuple[int, ...]]) -> None:
    if found.keys() != needed.keys():
        name = sorted(found.keys() ^ needed.keys())[0]
        word = "missing" if name in needed else "unknown"
        raise InputError(f"{path}: tensor {name} is {word}; {EXPECTED}")
    for name, tensor in found.items():
        if tensor.shape != needed[name] or tensor.dtype != np.float32:
            shape = f"{tensor.dtype} {tensor.shape}"
            raise InputError(f"{path}: tensor {name} is {shape}, not {needed[name]}")
        if not np.isfinite(tensor).all():
            raise InputError(f"{path}: tensor {name} holds NaN or infinity; {EXPECTED}")

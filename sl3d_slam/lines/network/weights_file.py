"""Weights as a safetensors file that says what network they belong to."""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from pydantic import ValidationError
from safetensors import SafetensorError
from safetensors.torch import load as load_tensors
from safetensors.torch import save as dump_tensors
from torch import Tensor

from sl3d_slam.errors import InputError
from sl3d_slam.files import write_whole
from sl3d_slam.lines.network.model import SuperLine3D
from sl3d_slam.lines.network.settings import NetworkSettings

FORMAT = "sl3d_slam line network 1"
MAX_BYTES = 2_000_000
EXPECTED = "expected weights written by sl3d train"


def save_weights(path: Path | str, model: SuperLine3D, about: Mapping[str, str]) -> None:
    """Write a model's weights and settings, and what is said about them; whole or not at all."""
    tensors = {name: value.detach().cpu().contiguous() for name, value in _named(model)}
    settings = model.settings.model_dump_json()
    header = {f"about.{key}": value for key, value in about.items()}
    header |= {"format": FORMAT, "settings": settings}
    write_whole(Path(path), dump_tensors(tensors, metadata=header))


def load_weights(path: Path | str) -> SuperLine3D:
    """Return the network of a weights file, on the CPU, ready for inference.

    Raises
    ------
    InputError
        where the file is missing, larger than 2 MB, damaged, of another program, or does not hold
        exactly the finite tensors that its settings ask for.
    """
    path = Path(path)
    raw = _read(path)
    settings = _settings(path, read_about(path))
    model = SuperLine3D(settings)
    try:
        tensors = load_tensors(raw)
    except SafetensorError as error:
        raise InputError(f"{path}: damaged ({error}); {EXPECTED}") from None
    _check_tensors(path, tensors, dict(_named(model)))
    model.load_state_dict(tensors)
    return model.eval()


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


def model_hash(model: SuperLine3D | Path | str) -> str:
    """Return eight hexadecimal digits that stand for a model: its settings and every weight."""
    if not isinstance(model, SuperLine3D):
        model = load_weights(model)
    digest = hashlib.sha256(model.settings.model_dump_json().encode())
    for name, value in sorted(_named(model)):
        digest.update(name.encode() + value.detach().cpu().numpy().tobytes())
    return digest.hexdigest()[:8]


def _named(model: SuperLine3D) -> list[tuple[str, Tensor]]:
    return list(model.state_dict().items())


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


def _check_tensors(path: Path, found: dict[str, Tensor], needed: dict[str, Tensor]) -> None:
    if found.keys() != needed.keys():
        name = sorted(found.keys() ^ needed.keys())[0]
        word = "missing" if name in needed else "unknown"
        raise InputError(f"{path}: tensor {name} is {word}; {EXPECTED}")
    for name, tensor in found.items():
        if tensor.shape != needed[name].shape or tensor.dtype != torch.float32:
            shape = f"{tensor.dtype} {tuple(tensor.shape)}"
            raise InputError(f"{path}: tensor {name} is {shape}, not {tuple(needed[name].shape)}")
        if not torch.isfinite(tensor).all():
            raise InputError(f"{path}: tensor {name} holds NaN or infinity; {EXPECTED}")

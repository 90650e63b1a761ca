"""A line map as one safetensors file: small, no pickle, nothing believed that is not checked.

The header holds one JSON text, ``sl3d_map``: the format's name and version, the frames, how each
array is coded, model, settings, and a checksum over all of it and the arrays.
"""

import hashlib
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from sl3d_slam.errors import InputError
from sl3d_slam.mapping.georeference import georeference_of, georeference_tree
from sl3d_slam.mapping.line_map import LineMap, MapOrigin
from sl3d_slam.mapping.tensors import CLOUD_CODING, CODING, Tensors, map_of, map_tensors

KEY = "sl3d_map"
MAPPED = {"cloud_keys": ("<u1", "U8"), "cloud_means": ("<u2", "U16")}
FORMAT = "sl3d line map"
VERSION = 2
DESCRIPTOR_BITS = {1: 6, 2: 4}  # of each version
FRAMES = (
    "metres; map: right-handed, as the run's world frame; keyframe: the lidar's frame, x forward, "
    "y left, z up; poses take keyframe coordinates to map coordinates"
)
EXPECTED = "expected a line map as sl3d map writes it"


def to_bytes(line_map: LineMap) -> bytes:
    """Return the content of a map file; the same map gives the same bytes."""
    tensors, cloud = map_tensors(line_map), line_map.cloud
    header = {
        "format": FORMAT,
        "version": VERSION,
        "frames": FRAMES,
        "coding": CODING if cloud is None else CODING | CLOUD_CODING,
        "cloud_voxel_m": None if cloud is None else cloud.voxel_m,
        "landmarks": len(line_map),
        "keyframes": len(line_map.keyframe_up),
        "model": line_map.origin.model,
        "simulated": line_map.origin.simulated,
        "config": line_map.origin.config,
    }
    if line_map.origin.georeference is not None:
        header["georeference"] = georeference_tree(line_map.origin.georeference)
    header["checksum"] = checksum(header, tensors)
    return save(tensors, {KEY: json.dumps(header, sort_keys=True)})


def read_map(path: Path) -> LineMap:
    """Return the map in a file; its cloud stays on disk, mapped, and is decoded where asked for.

    Raises
    ------
    InputError
        naming the file and what was expected.
    """
    header, tensors = _read_container(path)
    if header.pop("checksum", None) != checksum(header, tensors):
        raise InputError(f"{path}: is damaged, its checksum does not fit; {EXPECTED}")
    try:
        voxel_m, origin = _facts(header)
        return map_of(tensors, voxel_m, origin, DESCRIPTOR_BITS[header["version"]])
    except ValueError as error:
        raise InputError(f"{path}: is not a sound line map; {error}") from None


def _read_container(path: Path) -> tuple[dict[str, Any], Tensors]:
    if not path.is_file():
        found = "is a folder" if path.is_dir() else "does not exist"
        raise InputError(f"{path}: {found}; {EXPECTED}")
    try:
        with safe_open(path, framework="numpy") as file:
            header = _read_header(path, (file.metadata() or {}).get(KEY))
            mapped = _mapped(path)
            names = sorted(set(file.keys()) - set(mapped))
            return header, mapped | {name: file.get_tensor(name) for name in names}
    except (SafetensorError, TypeError, AttributeError, KeyError):  # the last: unusual types
        raise InputError(f"{path}: is cut off, damaged or of another kind; {EXPECTED}") from None
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror or error}); {EXPECTED}"
        ) from None


def _mapped(path: Path) -> Tensors:
    """Map the arrays of the cloud where they are in the file; safetensors checked its layout."""
    with path.open("rb") as file:
        (length,) = struct.unpack("<Q", file.read(8))
        layout = json.loads(file.read(length))
    tensors = {}
    for name, (dtype, code) in MAPPED.items():
        entry = layout.get(name, {})
        if entry.get("dtype") == code and 0 not in entry["shape"]:
            offset, shape = 8 + length + entry["data_offsets"][0], tuple(entry["shape"])
            tensors[name] = np.asarray(np.memmap(path, dtype, "r", offset, shape))
    return tensors


def _read_header(path: Path, text: str | None) -> dict[str, Any]:
    try:
        header = json.loads(text or "null")
    except (ValueError, RecursionError):
        header = None
    if not isinstance(header, dict) or header.get("format") != FORMAT:
        raise InputError(f"{path}: is a safetensors file of another kind; {EXPECTED}")
    version = header.get("version")
    if isinstance(version, int) and version > VERSION:
        raise InputError(
            f"{path}: is a line map of version {version}, newer than this program's {VERSION}; "
            "expected a map of that version or older, or a newer sl3d"
        )
    if not isinstance(version, int) or version not in DESCRIPTOR_BITS:
        raise InputError(f"{path}: does not say its version; {EXPECTED}")
    return header


def _facts(header: dict[str, Any]) -> tuple[float | None, MapOrigin]:
    """Return the edge of a voxel, where there is a cloud, and the map's origin."""
    voxel_m, simulated = header.get("cloud_voxel_m"), header.get("simulated")
    model, config = header.get("model"), header.get("config")
    if not (isinstance(model, str) and isinstance(config, str) and isinstance(simulated, bool)):
        raise ValueError("expected model and config as text, and simulated as true or false")
    origin = MapOrigin(model, config, simulated, georeference_of(header.get("georeference")))
    if voxel_m is None:
        return None, origin
    if not (isinstance(voxel_m, float | int) and 1e-3 <= voxel_m <= 1e3):
        raise ValueError("expected cloud voxels of 0.001 to 1000 m")
    return float(voxel_m), origin


def checksum(header: dict[str, Any], tensors: Tensors) -> str:
    """Return BLAKE2b over the header's other entries and every array with its name and form."""
    total = hashlib.blake2b(digest_size=16)
    total.update(json.dumps(header, sort_keys=True).encode())
    for name in sorted(tensors):
        tensor = np.ascontiguousarray(tensors[name])
        total.update(f"{name} {tensor.dtype.str} {tensor.shape}".encode())
        total.update(tensor.data if tensor.size else b"")
    return total.hexdigest()

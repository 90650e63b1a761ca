"""PLY point clouds, ascii and binary: the scalar properties of the element ``vertex``."""

import io
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from sl3d_slam.errors import InputError
from sl3d_slam.io.points import Cloud, cloud_from_fields
from sl3d_slam.io.scan_file import read_bytes

EXPECTED = "a PLY file whose element 'vertex' has x, y and z"
MAX_HEADER_BYTES = 64 * 1024
_END = b"end_header"
_BYTE_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
_FORMATS = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1",
    "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "int64": "i8", "uint64": "u8",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip


@dataclass(slots=True)
class _Element:
    name: str
    count: int
    properties: list[tuple[str, str]] = field(default_factory=list)
    has_list: bool = False


def read_ply(path: Path) -> Cloud:
    """Return points and point times of a PLY file; faces and other later elements are ignored.

    Raises
    ------
    InputError
        naming the file where its header is damaged or it holds fewer bytes than the header says.
    """
    raw = read_bytes(path, EXPECTED)
    end = raw.find(_END, 0, MAX_HEADER_BYTES)
    newline = raw.find(b"\n", end)
    if not raw.startswith(b"ply") or end < 0 or newline < 0:
        raise InputError(f"{path}: has no PLY header; expected {EXPECTED}")
    try:
        order, elements = _parse_header(raw[:end].decode("ascii"))
        vertex, skipped = _find_vertex(elements)
        body = memoryview(raw)[newline + 1 :]
        if order == _BYTE_ORDERS["ascii"]:
            fields = _read_ascii(body, vertex, skipped)
        else:
            fields = _read_binary(body, vertex, skipped, order)
    except (ValueError, KeyError, IndexError) as error:
        raise InputError(f"{path}: is damaged ({error}); expected {EXPECTED}") from None
    return cloud_from_fields(fields, str(path))


def _parse_header(header: str) -> tuple[str, list[_Element]]:
    order, elements = "", list[_Element]()
    for line in header.splitlines()[1:]:
        match line.split():
            case ["format", name, _]:
                order = _BYTE_ORDERS[name]
            case ["element", name, count]:
                elements.append(_Element(name, int(count)))
            case ["property", "list", *_]:
                elements[-1].has_list = True
            case ["property", kind, name]:
                elements[-1].properties.append((name, _FORMATS[kind]))
    if not order:
        raise ValueError("no format line")
    return order, elements


def _find_vertex(elements: list[_Element]) -> tuple[_Element, list[_Element]]:
    """Return the vertex element and those that lie before it in the file."""
    names = [element.name for element in elements]
    position = names.index("vertex") if "vertex" in names else -1
    if position < 0:
        raise ValueError("no element vertex")
    needed = elements[: position + 1]
    if any(element.has_list for element in needed):
        raise ValueError("a list property before or among the points")
    if any(element.count < 0 for element in needed):
        raise ValueError("a negative count")
    return needed[-1], needed[:-1]


def _read_binary(
    body: memoryview, vertex: _Element, skipped: list[_Element], order: str
) -> np.ndarray:
    offset = sum(element.count * _dtype(element, order).itemsize for element in skipped)
    dtype = _dtype(vertex, order)
    if offset + vertex.count * dtype.itemsize > len(body):
        raise ValueError(f"{len(body)} bytes are too few for {vertex.count} points")
    return np.frombuffer(body, dtype, count=vertex.count, offset=offset)


def _read_ascii(body: memoryview, vertex: _Element, skipped: list[_Element]) -> np.ndarray:
    start = sum(element.count for element in skipped)
    if start + vertex.count > len(body):  # each row takes a byte at least: bounds the loop below
        raise ValueError(f"{len(body)} bytes are too few for {vertex.count} points")
    lines = io.BytesIO(body)
    for _ in range(start):
        lines.readline()
    dtype = np.dtype([(name, "f8" if kind[0] == "f" else kind) for name, kind in vertex.properties])
    if vertex.count == 0:
        return np.empty(0, dtype)
    fields = np.loadtxt(lines, dtype, max_rows=vertex.count, comments=None, ndmin=1)
    if len(fields) != vertex.count:
        raise ValueError(f"{len(fields)} rows for {vertex.count} points")
    return fields


def _dtype(element: _Element, order: str) -> np.dtype:
    return np.dtype([(name, order + kind) for name, kind in element.properties])

"""PCD point clouds by pypcd4; its header is checked first, as it allocates what a header claims."""

import io
import struct
from pathlib import Path

import numpy as np
from pydantic import ValidationError
from pypcd4.pypcd4 import Encoding, MetaData, PointCloud

from sl3d_slam.errors import InputError
from sl3d_slam.io.points import Cloud, cloud_from_fields
from sl3d_slam.io.scan_file import read_bytes

EXPECTED = "a PCD file (ascii, binary or binary_compressed) with fields x, y and z"
MAX_HEADER_BYTES = 64 * 1024
MAX_LZF_RATIO = 100  # three bytes of LZF give at most 264
_COMPRESSED_SIZES = struct.Struct("<II")


def read_pcd(path: Path) -> Cloud:
    """Return points and point times of a PCD file.

    Raises
    ------
    InputError
        naming the file where its header is damaged or it holds fewer bytes than the header says.
    """
    raw = read_bytes(path, EXPECTED)
    try:
        _check_size(raw)
        fields = PointCloud.from_fileobj(io.BufferedReader(io.BytesIO(raw))).pc_data
    except ValidationError as error:
        key = ".".join(str(part) for part in error.errors()[0]["loc"]).upper()
        raise InputError(f"{path}: header line {key} is wrong; expected {EXPECTED}") from None
    except (ValueError, KeyError, TypeError, RuntimeError, struct.error) as error:
        raise InputError(f"{path}: is damaged ({error}); expected {EXPECTED}") from None
    return cloud_from_fields(np.atleast_1d(fields), str(path))


def _check_size(raw: bytes) -> None:
    """Raise ValueError where the body cannot hold the points that the header promises."""
    header, body = _split(raw)
    metadata = MetaData.parse_header(header)
    fields = (metadata.fields, metadata.size, metadata.type, metadata.count)
    if len({len(column) for column in fields}) != 1:
        raise ValueError("FIELDS, SIZE, TYPE and COUNT differ in length")
    if metadata.width * metadata.height != metadata.points:
        raise ValueError("POINTS is not WIDTH times HEIGHT")
    if sum(metadata.count) > MAX_HEADER_BYTES:
        raise ValueError("COUNT is too large")
    promised = metadata.points * metadata.build_dtype().itemsize
    match metadata.data:
        case Encoding.ASCII:
            available = body.count(b"\n") + (not body.endswith(b"\n"))
            promised = metadata.points
        case Encoding.BINARY:
            available = len(body)
        case _:
            available = _uncompressed_size(body)
    if promised > available:
        raise ValueError(f"the body is too short for {metadata.points} points")


def _split(raw: bytes) -> tuple[list[str], bytes]:
    start = raw.find(b"\nDATA ", 0, MAX_HEADER_BYTES)
    end = raw.find(b"\n", start + 1)
    if start < 0 or end < 0:
        raise ValueError("no line DATA")
    return raw[:end].decode("utf-8").splitlines(), raw[end + 1 :]


def _uncompressed_size(body: bytes) -> int:
    compressed, uncompressed = _COMPRESSED_SIZES.unpack_from(body)
    if compressed > len(body) - _COMPRESSED_SIZES.size:
        raise ValueError("the compressed block is cut off")
    if uncompressed > MAX_LZF_RATIO * compressed:
        raise ValueError("the compressed block claims an impossible size")
    return uncompressed

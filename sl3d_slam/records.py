"""Bytes by name in one append-only file: what a run keeps, out of memory and beyond its death.

A record is two little-endian u32, the length and the CRC-32 of what follows: a name, a zero byte
and the content. A process that dies while it writes leaves a torn record at the end, which is cut
off when the file is opened again.
"""

import os
import struct
import tempfile
import zlib
from io import FileIO
from pathlib import Path

from sl3d_slam.errors import OutputError
from sl3d_slam.files import why

_HEAD = struct.Struct("<II")


class RecordFile:
    """A growing file of named records; a name that is written again replaces the older record."""

    def __init__(self, file: FileIO, label: str) -> None:
        """Take over an open file and index what is in it; ``label`` names it in errors."""
        self._file, self._label = file, label
        self._places: dict[str, tuple[int, int]] = {}
        self._end = self._index()
        file.truncate(self._end)

    @classmethod
    def temporary(cls) -> "RecordFile":
        """Return an empty file without a name, which is gone when it is closed."""
        label = f"a temporary file in {tempfile.gettempdir()}"
        try:
            return cls(tempfile.TemporaryFile(buffering=0), label)
        except OSError as error:
            raise OutputError(f"{label}: cannot be made because {why(error)}") from None

    @classmethod
    def open(cls, path: Path) -> "RecordFile":
        """Open a file and keep its whole records, or make it; its folder is made, too."""
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.touch()
            return cls(path.open("r+b", buffering=0), str(path))
        except OSError as error:
            raise OutputError(f"{path}: cannot be written because {why(error)}") from None

    def __contains__(self, name: str) -> bool:
        """Tell whether there is a record of this name."""
        return name in self._places

    def __len__(self) -> int:
        """Return the number of names."""
        return len(self._places)

    def __getitem__(self, name: str) -> bytes:
        """Return the content of a record; KeyError where there is none."""
        start, size = self._places[name]
        return os.pread(self._file.fileno(), size, start)

    def __setitem__(self, name: str, content: bytes) -> None:
        """Append a record.

        Raises
        ------
        OutputError
            where the disk is full; the records before are whole.
        """
        key = name.encode() + b"\0"
        crc = zlib.crc32(content, zlib.crc32(key))
        record = b"".join((_HEAD.pack(len(key) + len(content), crc), key, content))
        try:
            written = 0
            while written < len(record):
                written += os.pwrite(self._file.fileno(), record[written:], self._end + written)
        except OSError as error:
            raise OutputError(f"{self._label}: cannot grow because {why(error)}") from None
        self._note(name, self._end, len(key), len(content))

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _note(self, name: str, start: int, key_size: int, size: int) -> None:
        first = start + _HEAD.size + key_size
        self._places[name] = (first, size)
        self._end = first + size

    def _index(self) -> int:
        """Note every whole record and return where they end."""
        self._end, size = 0, os.fstat(self._file.fileno()).st_size
        while self._end + _HEAD.size <= size:
            head = os.pread(self._file.fileno(), _HEAD.size, self._end)
            length, crc = _HEAD.unpack(head)
            if self._end + _HEAD.size + length > size:
                break
            body = os.pread(self._file.fileno(), length, self._end + _HEAD.size)
            key, separator, content = body.partition(b"\0")
            if zlib.crc32(body) != crc or not separator:
                break
            self._note(key.decode(), self._end, len(key) + 1, len(content))
        return self._end

"""Files appear whole or not at all: write beside, flush to disk, rename."""

import errno
import os
import secrets
from pathlib import Path

from sl3d_slam.errors import OutputError

_REASONS = {
    errno.ENOSPC: "the disk is full",
    errno.EDQUOT: "the disk quota is used up",
    errno.EROFS: "the file system is read-only",
    errno.EACCES: "there is no permission to write there",
    errno.EPERM: "there is no permission to write there",
    errno.ENOTDIR: "a part of the path is a file, not a folder",
    errno.EISDIR: "it is a folder, not a file",
    errno.ENOENT: "its folder does not exist",
}


def write_whole(path: Path, content: bytes | str) -> None:
    """Write a file so that a reader sees the old content or all of the new, never a part.

    Text is written as UTF-8. The temporary file lies in the same folder and is removed on failure.

    Raises
    ------
    OutputError
        naming the file and why it could not be written.
    """
    raw = content.encode("utf-8") if isinstance(content, str) else content
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}.tmp")
    try:
        try:
            with temporary.open("xb") as file:
                file.write(raw)
                file.flush()
                os.fsync(file.fileno())
            temporary.replace(path)
            _flush_folder(path.parent)
        finally:
            temporary.unlink(missing_ok=True)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written because {why(error)}") from None


def prepare_run_folder(path: Path) -> Path:
    """Create the folder of a run and prove, before hours of work, that files can be written in it.

    Raises
    ------
    OutputError
        naming the folder and why it cannot be used.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
        _probe(path)
    except FileExistsError:
        raise OutputError(f"{path}: is a file; expected a folder for the results") from None
    except OSError as error:
        raise OutputError(
            f"{path}: cannot be used as the folder for the results because {why(error)}"
        ) from None
    return path


def prove_writable(path: Path, suffixes: tuple[str, ...] = ()) -> None:
    """Prove, before the work, that a file can be written; what is there already stays.

    Raises
    ------
    OutputError
        naming the file, where its name ends in none of the ``suffixes`` or why it cannot be there.
    """
    if suffixes and path.suffix.lower() not in suffixes:
        raise OutputError(f"{path}: expected a name that ends in {', '.join(suffixes)}")
    try:
        if path.is_dir():
            raise IsADirectoryError(errno.EISDIR, "")
        _probe(path.parent)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written because {why(error)}") from None


def _probe(folder: Path) -> None:
    """Write a file in a folder and remove it again."""
    probe = folder / f".probe.{secrets.token_hex(4)}.tmp"
    try:
        probe.write_bytes(b"probe")
    finally:
        probe.unlink(missing_ok=True)


def no_file(path: Path) -> str:
    """Return in words what is where a regular file was expected."""
    return "is a folder" if path.is_dir() else "not found"


def why(error: OSError) -> str:
    """Return in words why the system refused a file."""
    return _REASONS.get(error.errno or 0, error.strerror or "of an unknown system error")


def _flush_folder(folder: Path) -> None:
    """Make the rename itself durable; a file system that cannot sync folders is no failure."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP, errno.EBADF):
            raise
    finally:
        os.close(descriptor)

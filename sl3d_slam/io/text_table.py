"""Tables of numbers in text files, with a bound on size and an error that names the line."""

from pathlib import Path

import numpy as np
from jaxtyping import Float64

from sl3d_slam.errors import InputError
from sl3d_slam.files import no_file

MAX_TEXT_BYTES = 256 * 1024 * 1024


def read_text(path: Path, expected: str) -> str:
    """Return the text of a file; ``expected`` says in the error what the file should have been."""
    try:
        if not path.is_file():
            raise InputError(f"{path}: {no_file(path)}; expected {expected}")
        if path.stat().st_size > MAX_TEXT_BYTES:
            raise InputError(f"{path}: larger than {MAX_TEXT_BYTES} bytes; expected {expected}")
        return path.read_text(encoding="utf-8")
    except UnicodeDecodeError:
        raise InputError(f"{path}: is not text; expected {expected}") from None
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror}); expected {expected}"
        ) from None


def read_table(path: Path, columns: int, expected: str) -> Float64[np.ndarray, "N C"]:
    """Return the rows of a text file of finite numbers; blank lines and ``#`` lines are skipped.

    Raises
    ------
    InputError
        naming the file and the first line that does not hold exactly ``columns`` numbers.
    """
    rows: list[list[float]] = []
    for number, line in enumerate(read_text(path, expected).splitlines(), start=1):
        words = line.split("#", 1)[0].split()
        if not words:
            continue
        row = _parse_row(words)
        if row is None or len(row) != columns:
            raise InputError(
                f"{path}: line {number} is not {columns} finite numbers; expected {expected}"
            )
        rows.append(row)
    if not rows:
        raise InputError(f"{path}: holds no numbers; expected {expected}")
    return np.array(rows, dtype=np.float64)


def _parse_row(words: list[str]) -> list[float] | None:
    try:
        row = [float(word) for word in words]
    except ValueError:
        return None
    return row if np.isfinite(row).all() else None

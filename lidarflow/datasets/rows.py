"""Tables of points as PCD and PLY store them: named columns, in text or in bytes."""

import warnings
from pathlib import Path

import numpy as np

from lidarflow.errors import DataError

MAX_HEADER_BYTES = 1 << 16


def split_header(path: Path, content: bytes, last_line: bytes) -> tuple[list[str], bytes]:
    """Header lines up to the one that starts with `last_line`, and the bytes after it.

    Raises DataError where the header does not end within 64 KiB.
    """
    lines, start = [], 0
    while True:
        end = content.find(b"\n", start, MAX_HEADER_BYTES)
        if end < 0:
            raise DataError(f"{path}: its header has no line '{last_line.decode()}'; "
                            f"the file is truncated or not {path.suffix.lower()}")
        line = content[start:end].strip()
        lines.append(line.decode("ascii", "replace"))
        start = end + 1
        if line.split(b" ")[0] == last_line:
            return lines, content[start:]


def whole_number(path: Path, text: str, what: str) -> int:
    """A count of a header; DataError unless it is digits."""
    if not text.isdigit() or len(text) > 18:
        raise DataError(f"{path}: header says {what} '{text}'; expected a whole number")
    return int(text)


def from_bytes(path: Path, body: bytes, count: int, row: np.dtype) -> np.ndarray:
    """`count` rows of structured type `row`; DataError where the bytes do not suffice."""
    if len(body) < count * row.itemsize:
        raise DataError(f"{path}: header says {count} points of {row.itemsize} bytes, but only {len(body)} "
                        "bytes follow; the file is truncated")
    return np.frombuffer(body, dtype=row, count=count)


def from_text(path: Path, body: bytes, count: int, columns: int) -> np.ndarray:
    """The first `count` lines of numbers (count, columns); DataError where there are fewer or others."""
    lines = [line for line in body.decode("ascii", "replace").splitlines() if line.strip()]
    if len(lines) < count:
        raise DataError(f"{path}: header says {count} points, but {len(lines)} lines follow; "
                        "the file is truncated")
    if count == 0:
        return np.empty((0, columns))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            table = np.loadtxt(lines[:count], comments=None, ndmin=2)
    except ValueError as error:
        reason = str(error).splitlines()[0]
        raise DataError(f"{path}: expected lines of {columns} numbers ({reason})") from None
    if table.shape != (count, columns):
        raise DataError(f"{path}: its lines hold {table.shape[1]} numbers, but the header says {columns}")
    return table

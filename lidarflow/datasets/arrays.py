"""Arrays in .npy and .npz files: plain numbers and texts, never a pickle, never more than the file holds.

numpy believes a header and sets aside what it announces before it reads; here headers are checked first.
"""

import math
import tokenize
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO

import numpy as np

# What damaged archives make of Python's and numpy's readers.
ERRORS = (OSError, ValueError, TypeError, EOFError, KeyError, RuntimeError, MemoryError, SyntaxError,
          OverflowError, RecursionError, tokenize.TokenError, zipfile.BadZipFile, zlib.error)
_MOST_UNPACKED = 1032      # deflate packs no byte more than so many times
_HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}


class MissingArray(Exception):
    """An archive lacks arrays; their names, and those that it has."""

    def __init__(self, missing: list[str], held: list[str]):
        super().__init__(f"lacks {', '.join(missing)}")
        self.missing, self.held = missing, held


def from_npy(path: Path) -> np.ndarray:
    """The array of an .npy file, left on disk until it is used; one of ERRORS where it is damaged."""
    if zipfile.is_zipfile(path):
        raise ValueError("an .npz archive under the name of an .npy file; rename it")
    with Path(path).open("rb") as file:
        shape, by_column, dtype = _header(file, Path(path).name)
        _check_size(Path(path).name, shape, dtype, Path(path).stat().st_size - file.tell(), exactly=False)
        start = file.tell()
    if not math.prod(shape):
        return np.zeros(shape, dtype)
    return np.memmap(path, dtype, "r", start, shape, "F" if by_column else "C")


def from_npz(path: Path, names: Sequence[str] = ()) -> dict[str, np.ndarray]:
    """The arrays of an .npz file, those of `names` or all.

    Raises MissingArray, and one of ERRORS where the file is damaged or holds what is no plain array.
    """
    with zipfile.ZipFile(path) as archive:
        held = {info.filename.removesuffix(".npy"): info for info in archive.infolist()
                if info.filename.endswith(".npy")}
        missing = [name for name in names if name not in held]
        if missing:
            raise MissingArray(missing, list(held))
        return {name: _member(archive, held[name]) for name in names or held}


def check_unpacked(info: zipfile.ZipInfo) -> None:
    """Raise ValueError where a member of an archive announces more bytes than its own can unpack to."""
    if info.file_size > _MOST_UNPACKED * info.compress_size + _MOST_UNPACKED:
        raise ValueError(f"{info.filename} says that {info.compress_size} bytes unpack to {info.file_size}")


def _member(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> np.ndarray:
    check_unpacked(info)
    with archive.open(info) as member:
        shape, by_column, dtype = _header(member, info.filename)
        _check_size(info.filename, shape, dtype, info.file_size - member.tell(), exactly=True)
        content = bytearray(member.read())
    if not content:
        return np.zeros(shape, dtype)
    return np.frombuffer(content, dtype).reshape(shape, order="F" if by_column else "C")


def _header(file: BinaryIO, name: str) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Shape, whether columns come first, and type of the array that begins here; ValueError for a pickle."""
    read_header = _HEADERS.get(np.lib.format.read_magic(file))
    if read_header is None:
        raise ValueError(f"{name} is of an unknown version")
    shape, by_column, dtype = read_header(file)
    if dtype.hasobject:
        raise ValueError(f"{name} holds Python objects (a pickle), which are never loaded")
    return shape, by_column, dtype


def _check_size(name: str, shape: tuple[int, ...], dtype: np.dtype, there: int, exactly: bool) -> None:
    """Raise ValueError unless the array has as many bytes as are there, or has them at least."""
    announced = math.prod(shape) * dtype.itemsize
    fits = announced == there if exactly else announced <= there
    if not fits or min(shape, default=0) < 0 or (math.prod(shape) and not dtype.itemsize):
        raise ValueError(f"{name} says {shape} of {dtype}, {announced} bytes, but holds {there}")

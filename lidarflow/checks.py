"""What the frozen data types check at their door; ValueErrors that say what was expected and found.

What programs hand over, such as points, is an InputError, which is a LidarflowError too.
"""

import os
from pathlib import Path
from typing import Any

import numpy as np

from lidarflow import pose
from lidarflow.errors import InputError
from lidarflow.rows import whole_or_nan

_NS_LIMIT = 2**63
_KINDS = {"b": "bool", "f": "float", "i": "int", "u": "unsigned int"}     # what numpy's letters stand for


def as_points(name: str, points: Any) -> np.ndarray:
    """Points (N, 3) float64 of any numbers; what is not finite, or masked, in part is a NaN row.

    What is that already is not copied. Raises InputError, which calls the points `name`, for anything else.
    """
    expected = "expected points (N, 3)"
    if isinstance(points, str | os.PathLike):
        raise InputError(f"{name}: the path {os.fspath(points)!r}; {expected}, "
                         "lidarflow.read_scan reads them from a file")
    try:
        found = np.asanyarray(points)     # keeps a mask
    except (TypeError, ValueError, RuntimeError) as error:
        kind = type(points).__name__
        raise InputError(f"{name}: a {kind} that is no array ({error}); {expected}") from None
    if found.dtype.kind == "O" and found.ndim == 0:
        raise InputError(f"{name}: of type {type(points).__name__}; {expected}")
    if found.dtype.kind == "O":
        raise InputError(f"{name}: an array {found.shape} of dtype object, as rows of unequal length or "
                         f"entries that are no numbers make it; {expected} of numbers, such as float64")
    if found.ndim != 2 or found.shape[1] != 3 or found.dtype.kind not in "fiu":
        raise InputError(f"{name}: an array {found.shape} of {found.dtype}; {expected}; "
                         "where rows have more columns, pass points[:, :3]")
    with np.errstate(invalid="ignore", over="ignore"):     # a signalling NaN is a NaN
        if isinstance(found, np.ma.MaskedArray):
            found = np.ma.filled(found.astype(np.float64), np.nan)
        return whole_or_nan(np.ascontiguousarray(found, np.float64))


def as_path(name: str, path: Any) -> Path:
    """A path; InputError, which calls it `name`, for anything but a str or a path."""
    if not isinstance(path, str | os.PathLike) or isinstance(os.fspath(path), bytes):
        raise InputError(f"{name}: of type {type(path).__name__}; expected a path, a str or pathlib.Path")
    return Path(path)


def as_time_ns(name: str, time_ns: Any) -> int:
    """A time in nanoseconds as a Python int, which cannot overflow; InputError unless it is whole."""
    if not is_whole(time_ns) or not -_NS_LIMIT <= time_ns < _NS_LIMIT:
        raise InputError(f"{name}: time_ns is {time_ns!r}; expected whole nanoseconds in 64 bits, "
                         "such as round(seconds * 1e9)")
    return int(time_ns)


def is_whole(number: Any) -> bool:
    """Whether something is an integer of Python or numpy, which truth values are not."""
    return isinstance(number, int | np.integer) and not isinstance(number, bool)


def check_given(name: str, array: Any, shape: tuple, kind: str, expected: str) -> None:
    """As `check`, of what a program hands over: raises InputError, which says what is `expected`."""
    try:
        check(name, array, shape, kind)
    except ValueError as error:
        raise InputError(f"{error}; pass {expected}") from None


def check(name: str, array: np.ndarray, shape: tuple, kind: str) -> None:
    """Raise ValueError unless `array` has `shape` (None = any length) and dtype kind in `kind`."""
    if not isinstance(array, np.ndarray):
        raise ValueError(f"{name}: expected a numpy array, got {type(array).__name__}")
    wanted = "(" + ", ".join("N" if n is None else str(n) for n in shape) + (",)" if len(shape) == 1 else ")")
    fits = array.ndim == len(shape) and all(
        n is None or n == m for n, m in zip(shape, array.shape, strict=True)
    )
    if not fits:
        raise ValueError(f"{name}: expected shape {wanted}, got {array.shape}")
    if array.dtype.kind not in kind:
        wanted = " or ".join(_KINDS[letter] for letter in kind)
        raise ValueError(f"{name}: expected dtype {wanted}, got {array.dtype}")
    if np.ma.is_masked(array):
        raise ValueError(f"{name}: expected no mask, got {np.ma.count_masked(array)} masked values")


def check_motion(name: str, motion: np.ndarray) -> None:
    """Raise ValueError unless `motion` is a finite rigid motion (4, 4)."""
    check(name, motion, (4, 4), "f")
    if not pose.is_rigid(motion, tolerance=1e-4):
        raise ValueError(f"{name}: expected a rigid motion, got {motion.tolist()}")

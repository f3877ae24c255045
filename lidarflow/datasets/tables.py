"""Small text files that lie beside scans: times and poses."""

import itertools
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from lidarflow import pose
from lidarflow.datasets.base import frame_number, rows_of_scans
from lidarflow.errors import DataError

RIGID_TOLERANCE = 1e-3
_MAX_SECONDS = 9e9


def read_lines(path: Path) -> list[str]:
    """Lines of a text file that are neither blank nor comments (#); DataError where it cannot be read."""
    try:
        lines = Path(path).read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: cannot be read ({error})") from None
    return [line for line in lines if line.strip() and not line.lstrip().startswith("#")]


def read_numbers(path: Path, columns: int) -> np.ndarray:
    """Finite numbers (N, columns) float64, one row per line; DataError for a line with other content."""
    return np.array([_row(path, line, columns) for line in read_lines(path)]).reshape(-1, columns)


def read_named(path: Path) -> dict[str, str]:
    """What follows the first word of every line, by that word without its colon, as in calibration files."""
    found = {}
    for line in read_lines(path):
        name, _, text = line.strip().partition(" ")
        found[name.rstrip(":")] = text.strip()
    return found


def numbers_of_text(path: Path, text: str, count: int) -> np.ndarray:
    """`count` finite numbers; `path` is where the text was read from."""
    return np.array(_row(path, text, count))


def motion_of_text(path: Path, text: str) -> np.ndarray:
    """A motion (4, 4) written as twelve numbers; `path` is where it was read from."""
    return _as_motions(path, np.array([_row(path, text, 12)]))[0]


def motion_of_texts(path: Path, rotation: str, translation: str) -> np.ndarray:
    """A motion (4, 4) written as nine numbers of a rotation and three of a translation."""
    rows = np.hstack([numbers_of_text(path, rotation, 9).reshape(3, 3),
                      numbers_of_text(path, translation, 3)[:, None]])
    return _as_motions(path, rows.reshape(1, 12))[0]


def read_seconds(path: Path) -> list[int]:
    """Times in ns of a file with one time in seconds per line."""
    seconds = read_numbers(path, 1)[:, 0]
    check_seconds(path, seconds)
    return [round(time_s * 1e9) for time_s in seconds.tolist()]


def check_seconds(path: Path, seconds: np.ndarray) -> None:
    """Raise DataError for times (N,) in seconds that 64-bit nanoseconds do not hold."""
    if (np.abs(seconds) > _MAX_SECONDS).any():
        raise DataError(f"{path}: a time of {seconds[np.abs(seconds).argmax()]:g} s; expected seconds, fewer "
                        f"than {_MAX_SECONDS:g}")


def read_dates(path: Path) -> list[int]:
    """Times in ns since 1970 of a file with one line such as "2011-09-26 13:02:25.951199337"."""
    return [date_to_ns(line.strip(), path) for line in read_lines(path)]


def date_to_ns(text: str, path: Path) -> int:
    """Time in ns since 1970 of a date and time of day with up to nine decimals, taken as UTC."""
    whole, _, decimals = text.partition(".")
    try:
        seconds = datetime.strptime(whole, "%Y-%m-%d %H:%M:%S").replace(tzinfo=UTC).timestamp()
        return round(seconds) * 1_000_000_000 + int(decimals[:9].ljust(9, "0"))
    except ValueError:
        raise DataError(f"{path}: expected a time like 2011-09-26 13:02:25.95, got '{text[:40]}'") from None


def times_of_scans(path: Path, times_ns: list[int],
                   files: Sequence[Path]) -> tuple[list[int] | None, list[str]]:
    """Times of `files` out of those read from `path`, and a note where they do not fit together."""
    picked = rows_of_scans(len(times_ns), files)
    if picked is None:
        return None, [f"{path.name} has {len(times_ns)} times for {len(files)} scans and is ignored"]
    found = [times_ns[row] for row in picked]
    for earlier, later in itertools.pairwise(found):
        if later <= earlier:
            order = f"{earlier * 1e-9:.9g} s before {later * 1e-9:.9g} s"
            return None, [f"{path.name} has {order} and is ignored"]
    return found, []


def read_motions(path: Path) -> np.ndarray:
    """Motions (N, 4, 4) of a file with one row-major 3x4 matrix per line (KITTI)."""
    return _as_motions(path, read_numbers(path, 12))


def read_indexed_motions(path: Path) -> dict[int, np.ndarray]:
    """Motions (4, 4) by frame number, of a file with a frame number and a 3x4 matrix per line."""
    table = read_numbers(path, 13)
    numbers = table[:, 0].astype(int).tolist()
    return dict(zip(numbers, _as_motions(path, table[:, 1:]), strict=True))


def motions_of_scans(path: Path, files: Sequence[Path]) -> tuple[np.ndarray | None, list[str]]:
    """Motions (N, 4, 4) of `files` from a file of 3x4 matrices, and a note where they do not fit together."""
    motions = read_motions(path)
    picked = rows_of_scans(len(motions), files)
    if picked is None:
        return None, [f"{path.name} has {len(motions)} poses for {len(files)} scans and is ignored"]
    return motions[picked], []


def indexed_motions_of_scans(path: Path, files: Sequence[Path]) -> tuple[np.ndarray | None, list[str]]:
    """Motions (N, 4, 4) of `files` from a file that names the frames, and a note where some are missing."""
    motions = read_indexed_motions(path)
    numbers = [frame_number(file) for file in files]
    missing = sum(number not in motions for number in numbers)
    if missing:
        return None, [f"{path.name} lacks {missing} of {len(files)} poses and is ignored"]
    return np.stack([motions[number] for number in numbers]), []


def _row(path: Path, line: str, columns: int) -> list[float]:
    try:
        row = [float(word) for word in line.split()]
    except ValueError:
        row = []
    if len(row) != columns or not np.isfinite(row).all():
        raise DataError(f"{path}: expected {columns} finite numbers per line, got '{line.strip()[:60]}'")
    return row


def _as_motions(path: Path, table: np.ndarray) -> np.ndarray:
    motions = pose.identity(len(table))
    motions[:, :3] = table.reshape(-1, 3, 4)
    if not pose.is_rigid(motions, RIGID_TOLERANCE):
        raise DataError(f"{path}: holds a matrix that is not a rigid motion; expected rows of [R | t]")
    return motions

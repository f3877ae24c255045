"""Point cloud files to arrays, every row kept in its place.

Damaged files are refused: a reader either returns exactly the rows that the file declares, or raises
DataError. (Open3D 0.20 fills the rows that it cannot read of .ply and ASCII .pcd with whatever was in
memory, which is why these formats are read here.)
"""

import re
import warnings
import zipfile
from collections import Counter
from collections.abc import Iterable, Sequence
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np

from lidarflow.checks import as_path
from lidarflow.datasets import arrays, pcd, ply
from lidarflow.datasets.kitti_correction import correct_vertical_angle, is_wanted
from lidarflow.errors import DataError
from lidarflow.types import Scan

KITTI_POINT_BYTES, NUSCENES_POINT_BYTES = 16, 20
_MOST_REFLECTANCE = 65535     # 0 to 1, to 255 or to 16 bits, as the sensor has it
_ODD_SHARE = 0.01     # of reflectances, which may be damaged; of coordinates, far more are negative
_MOST_FIELDS = 32     # more than a sensor tells of a point
_MOST_QUOTED = 60     # characters of a line that is no header
_TABLES = ("boxes.csv", "objects.csv")     # of what is labelled, and found: no clouds


def read_points(path: Path) -> np.ndarray:
    """Points (N, 3) float64 of a cloud file, metres, rows as in the file.

    A row with a coordinate that is not finite becomes NaN as a whole. Raises DataError for a file that
    is missing, damaged, empty or of an unknown kind.
    """
    path = Path(path)
    _check_is_file(path)
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise DataError(f"{path}: unknown kind of point cloud '{path.suffix}'; "
                        f"known are {' '.join(_READERS)}")
    try:
        if path.stat().st_size == 0:
            raise DataError(f"{path}: empty file (0 bytes); it was not written to the end, get it again")
        with np.errstate(invalid="ignore"):     # a signalling NaN is a NaN
            points = np.array(reader(path), dtype=np.float64, order="C")
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror or error})") from None
    except MemoryError:
        raise DataError(f"{path}: its points do not fit into memory") from None
    points[~np.isfinite(points).all(axis=1)] = np.nan
    if not np.isfinite(points).any():
        found = f"none of {len(points)} points is finite" if len(points) else "0 points"
        raise DataError(f"{path}: empty scan ({found}); leave this file out")
    return points


def read_scan(path: Path | str, kitti_correction: str = "auto") -> Scan:
    """One cloud file as a Scan; "auto" corrects .bin files that lie where KITTI puts them."""
    path = as_path("read_scan", path)
    points = read_points(path)
    if is_corrected(path, kitti_correction):
        points = correct_vertical_angle(points)
    return Scan(points, name=path.stem)


def is_corrected(path: Path, kitti_correction: str) -> bool:
    """Whether `read_scan` corrects the vertical angles of a file."""
    return is_wanted(kitti_correction, path.suffix.lower() == ".bin" and is_kitti_folder(path.parent))


def is_kitti_folder(folder: Path) -> bool:
    """Whether a folder has the name that KITTI gives to folders of scans."""
    folder = Path(folder).absolute()
    return folder.name == "velodyne" or (folder.name == "data" and folder.parent.name == "velodyne_points")


def list_clouds(folder: Path) -> list[Path]:
    """The cloud files of a folder in natural order; DataError unless there are some of just one kind."""
    files = visible_files(folder)
    found = Counter(file.suffix.lower() for file in files)
    kinds = kinds_of(files)
    if not kinds:
        raise DataError(f"{folder}: no {'/'.join(FOLDER_SUFFIXES)} files ({_found(folder, found)}); "
                        "is this the 'velodyne' folder?")
    if len(kinds) > 1:
        counts = " and ".join(f"{found[kind]} {kind}" for kind in kinds)
        raise DataError(f"{folder}: found {counts} files; expected scans of one kind, "
                        "move the others out of this folder")
    return natural_sorted(file for file in files if _kind(file) == kinds[0])


def kinds_of(files: Sequence[Path]) -> list[str]:
    """The suffixes of cloud files among `files`; .csv, as tables beside them have, if there is no other."""
    found = {_kind(file) for file in files}
    kinds = [suffix for suffix in FOLDER_SUFFIXES if suffix in found]
    return [kind for kind in kinds if kind != ".csv"] or kinds


def _kind(file: Path) -> str:
    return "" if file.name in _TABLES else file.suffix.lower()


def visible_files(folder: Path) -> list[Path]:
    """The files of a folder whose names do not begin with a dot; DataError where it cannot be listed."""
    try:
        return [file for file in Path(folder).iterdir() if file.is_file() and not file.name.startswith(".")]
    except OSError as error:
        raise DataError(f"{folder}: cannot be listed ({error.strerror or error})") from None


def natural_sorted(files: Iterable[Path]) -> list[Path]:
    """Files by name, numbers in names by value: scan2 comes before scan10, of equal ones 01 before 1.

    Where all are named by seconds (`seconds_of_names`), 5.05 comes before 5.1.
    """
    def key(file: Path) -> tuple[list, str]:
        parts = re.split(r"(\d+)", file.name)
        return [int(part) if part.isdecimal() else part for part in parts], file.name

    files = list(files)
    seconds = seconds_of_names(files)
    if seconds is None:
        return sorted(files, key=key)
    return [file for _, _, file in sorted(zip(seconds, (file.name for file in files), files, strict=True))]


def seconds_of_names(files: Sequence[Path]) -> list[Decimal] | None:
    """The seconds that files are named by, such as 1700000000.95; None unless all of them are.

    Counters such as 1.9 and 1.10 are no seconds: no writer that trims zeros leaves one, and any other writes
    all fractions with the same number of digits.
    """
    found = [re.fullmatch(r"[0-9]+(?:\.([0-9]+))?", file.stem) for file in files]
    fractions = [match[1] or "" for match in found if match]
    if len(fractions) < len(files) or not any(fractions):
        return None
    trimmed = all(fraction == "0" or not fraction.endswith("0") for fraction in fractions)
    if not trimmed and len({len(fraction) for fraction in fractions}) > 1:
        return None
    return [Decimal(file.stem) for file in files]


def check_names(files: Sequence[Path]) -> None:
    """Raise DataError where two files would share one file of results; some discs take a for A."""
    seen: dict[str, Path] = {}
    for file in files:
        other = seen.setdefault(file.stem.casefold(), file)
        if other is not file:
            raise DataError(f"{other} and {file.name}: are the same but for suffix and capitals, and results "
                            "are named by what remains; rename one of them")


def load_arrays(path: Path, keys: Sequence[str] = ()) -> dict[str, np.ndarray]:
    """Arrays of an .npz file, those of `keys` or all; DataError where it is damaged or lacks one."""
    if not zipfile.is_zipfile(path):
        raise DataError(f"{path}: not an .npz archive, or a truncated one; get it again")
    try:
        return arrays.from_npz(path, keys)
    except arrays.MissingArray as error:
        raise DataError(f"{path}: {error}; it holds {', '.join(error.held) or 'nothing'}") from None
    except arrays.ERRORS as error:
        raise DataError(f"{path}: not a readable .npz archive of plain arrays ({one_line(error)})") from None


def load_array(path: Path) -> np.ndarray:
    """The array of an .npy file, left on disk until it is used; DataError where it is damaged."""
    try:
        return arrays.from_npy(path)
    except arrays.ERRORS as error:
        raise DataError(f"{path}: not a readable .npy array ({one_line(error)})") from None


def one_line(error: BaseException) -> str:
    """The first line of an error's text, or its kind where it has none, without addresses in memory."""
    text = re.sub(r" ?<[^<>]* at 0x[0-9a-fA-F]+>", "", str(error))
    return (text.strip().splitlines() or [type(error).__name__])[0]


def _check_is_file(path: Path) -> None:
    if path.is_dir():
        raise DataError(f"{path}: is a folder; expected one point cloud file ({' '.join(_READERS)})")
    if not path.exists():
        raise DataError(f"{path}: no such file")
    if not path.is_file():
        raise DataError(f"{path}: not a regular file")


def _found(folder: Path, found: Counter) -> str:
    named = [f"{count} {suffix or 'without suffix'}" for suffix, count in found.most_common(3)]
    folders = sorted(entry.name for entry in folder.iterdir() if entry.is_dir() and entry.name[0] != ".")
    named += [f"folder{'s' if len(folders) > 1 else ''} {', '.join(folders[:4])}"] if folders else []
    return f"found {', '.join(named)}" if named else "it is empty"


def _read_bin(path: Path) -> np.ndarray:
    if path.name.lower().endswith(".pcd.bin"):
        return _read_nuscenes(path)
    _check_size(path, KITTI_POINT_BYTES, "x y z reflectance")
    rows = np.fromfile(path, dtype="<f4").reshape(-1, 4)
    reflectance = rows[np.isfinite(rows[:, :3]).all(axis=1), 3]
    odd = np.count_nonzero(~((reflectance >= 0) & (reflectance <= _MOST_REFLECTANCE)))
    if odd > _ODD_SHARE * len(reflectance):
        raise DataError(f"{path}: the fourth number of {odd} of {len(rows)} points is no reflectance (0 to "
                        f"{_MOST_REFLECTANCE}); expected float32 x y z reflectance per point, "
                        "save rows of another width as .npy")
    return rows[:, :3]


def _read_nuscenes(path: Path) -> np.ndarray:
    """A .pcd.bin of nuScenes, float32 x y z intensity ring per point."""
    _check_size(path, NUSCENES_POINT_BYTES, "x y z intensity ring")
    rows = np.fromfile(path, dtype="<f4").reshape(-1, 5)
    ring = rows[:, 4]
    odd = np.count_nonzero(~((ring >= 0) & (ring % 1 == 0)))
    if odd:
        raise DataError(f"{path}: the fifth number of {odd} of {len(rows)} points is no ring; expected "
                        "float32 x y z intensity ring per point, as nuScenes has it")
    return rows[:, :3]


def _check_size(path: Path, point_bytes: int, content: str) -> None:
    """Raise DataError unless a file of so many bytes a point ends with a point."""
    size = path.stat().st_size
    if size % point_bytes:
        raise DataError(f"{path}: {size} bytes are not a multiple of {point_bytes} (float32 {content} per "
                        "point); the file is truncated or of another format")


def _read_npy(path: Path) -> np.ndarray:
    return _columns(path, load_array(path))


def _read_npz(path: Path) -> np.ndarray:
    held = load_arrays(path)
    if "points" in held:
        return _columns(path, held["points"])
    fitting = [key for key, array in held.items() if _is_cloud(array)]
    if len(fitting) != 1:
        shapes = ", ".join(f"{key} {array.shape}" for key, array in held.items()) or "nothing"
        raise DataError(f"{path}: holds {shapes}; expected an array 'points' (N, 3)")
    return _columns(path, held[fitting[0]])


def _read_text(path: Path) -> np.ndarray:
    return _rows(path, [line.replace(",", " ") for line in _lines(path)])


def _read_csv(path: Path) -> np.ndarray:
    """Columns x, y and z by name where a first line has names, else the first three."""
    lines = [line for line in _lines(path) if line.strip()]
    names = [word.strip().strip('"').strip().lower() for word in (lines or [""])[0].lstrip("#/ ").split(",")]
    if {"x", "y", "z"} <= set(names):
        return _named_columns(path, lines[1:], names)
    if lines and not lines[0].lstrip().startswith("#") and not all(map(_is_number, names)):
        raise DataError(f"{path}: its first line says {', '.join(names)[:_MOST_QUOTED]}; expected numbers, "
                        "or names of columns with x, y and z among them")
    return _rows(path, lines, delimiter=",")     # an empty cell is no blank: what follows keeps its place


def _named_columns(path: Path, lines: list[str], names: list[str]) -> np.ndarray:
    """Points (N, 3) of `lines` with a column for each of the names; other columns may hold anything."""
    twice = [axis for axis in "xyz" if names.count(axis) > 1]
    if twice:
        raise DataError(f"{path}: has {names.count(twice[0])} columns {twice[0]}; expected one of each name")
    for number, line in enumerate(lines, 1):
        if '"' not in line and line.count(",") != len(names) - 1:     # what is quoted may hold commas
            raise DataError(f"{path}: row {number} has {line.count(',') + 1} columns, but the first line "
                            f"names {len(names)}; the file is truncated or damaged")
    return _rows(path, lines, delimiter=",", quotechar='"', comments=None,
                 usecols=[names.index(axis) for axis in "xyz"])


def _lines(path: Path) -> list[str]:
    try:
        return path.read_text(encoding="utf-8-sig").splitlines()     # some programs begin with a mark
    except UnicodeDecodeError as error:
        raise DataError(f"{path}: expected rows of numbers x y z ({one_line(error)})") from None


def _rows(path: Path, lines: list[str], **layout: Any) -> np.ndarray:
    """Points (N, 3) of lines of numbers with blanks between them, or in another layout (of np.loadtxt)."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            array = np.loadtxt(lines, ndmin=2, **layout)
    except ValueError as error:
        raise DataError(f"{path}: expected rows of numbers x y z ({one_line(error)})") from None
    return _columns(path, array) if array.size else np.empty((0, 3))


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _is_cloud(array: np.ndarray) -> bool:
    return array.ndim == 2 and array.shape[1] >= 3 and array.dtype.kind in "fiu"


def _columns(path: Path, array: np.ndarray) -> np.ndarray:
    if not _is_cloud(array):
        hint = "; an organised cloud: save array.reshape(-1, array.shape[2])" if array.ndim == 3 else ""
        raise DataError(
            f"{path}: an array {array.shape} of {array.dtype}; expected numbers (N, 3) or wider{hint}")
    if len(array) <= _MOST_FIELDS < array.shape[1]:
        raise DataError(f"{path}: an array {array.shape}; expected a row (N, 3) for each point, this looks "
                        "transposed, a column for each")
    return array[:, :3]


_READERS = {".bin": _read_bin, ".pcd": pcd.read, ".ply": ply.read, ".xyz": _read_text, ".txt": _read_text,
            ".csv": _read_csv, ".npy": _read_npy, ".npz": _read_npz}
FOLDER_SUFFIXES = tuple(suffix for suffix in _READERS if suffix != ".txt")

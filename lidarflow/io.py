"""What is written to disk, and how: archives, poses, tables, settings, and where a run keeps which.

Files are written aside and moved into place, so that a reader never meets half of one.
"""

import contextlib
import csv
import itertools
import json
import os
import zipfile
from collections.abc import Iterable, Iterator
from io import BytesIO, StringIO
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from lidarflow import pose
from lidarflow.config import Config
from lidarflow.datasets import arrays
from lidarflow.datasets.clouds import one_line
from lidarflow.errors import DataError
from lidarflow.rgbd_config import RgbdConfig
from lidarflow.settings import to_dict

FLOW_FOLDER = "flow"
CONFIG_FILE = "config.toml"
SOURCE_FILE = "source.json"
METRICS_FILE = "metrics.json"
RECORDING_FILE = "recording.rrd"
OBJECTS_FILE = "objects.csv"
TIMING_FILE = "timing.json"      # what a run writes last
OBJECT_COLUMNS = ("frame", "id", "points", "x", "y", "z", "length", "width", "height", "yaw",
                  "vx", "vy", "vz", "speed_m_per_s")
RESUME_FOLDER = ".resume"      # what a run keeps until it is complete


@contextlib.contextmanager
def written_aside(path: Path) -> Iterator[Path]:
    """A path to write to that replaces `path` when the block ends well and vanishes when it does not.

    Missing folders are made, and vanish too where nothing comes into them. Raises DataError where the file
    system refuses.
    """
    path = Path(path)
    aside = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        missing = list(itertools.takewhile(lambda folder: not folder.exists(), path.parents))
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            yield aside
            with aside.open("rb+") as file:
                os.fsync(file.fileno())
            os.replace(aside, path)
        finally:
            aside.unlink(missing_ok=True)
            for folder in missing:
                with contextlib.suppress(OSError):     # it holds something, or was not even made
                    folder.rmdir()
    except OSError as error:
        reason = error.strerror or str(error)
        raise DataError(f"cannot write {path}: {reason}; free space or choose another --out") from error


def archive(arrays: dict[str, np.ndarray]) -> bytes:
    """The bytes of an .npz file, compressed as fast as it goes: NumPy's own takes twice as long for 1 % less.

    In memory: on a full disk NumPy may name an open handle as the reason; bytes fail as any file does.
    """
    content = BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as packed:
        for name, array in arrays.items():
            with packed.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, np.asanyarray(array), allow_pickle=False)
    return content.getvalue()


def is_whole(path: Path) -> bool:
    """Whether a flow file is there and was not cut off, as far as its table of contents tells."""
    return zipfile.is_zipfile(path)


def write_poses_kitti(path: Path, world_from_sensor: np.ndarray) -> None:
    """Write poses (N, 4, 4), a row-major 3x4 matrix per line."""
    rows = world_from_sensor[:, :3].reshape(-1, 12)
    write_text(path, "".join(_joined(row) + "\n" for row in rows.tolist()))


def write_poses_tum(path: Path, world_from_sensor: np.ndarray, times_ns: list[int]) -> None:
    """Write poses (N, 4, 4) at `times_ns`: seconds tx ty tz qx qy qz qw per line."""
    rows = pose.to_translation_quaternion(world_from_sensor).tolist()
    lines = [f"{time_ns // 10**9}.{time_ns % 10**9:09d} {_joined(row)}\n"
             for time_ns, row in zip((int(time_ns) for time_ns in times_ns), rows, strict=True)]
    write_text(path, "".join(lines))


def write_objects(path: Path, rows: Iterable[tuple]) -> None:
    """Write moving objects as CSV, a row each with the values of OBJECT_COLUMNS; decimals are 0.1 mm."""
    text = StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(OBJECT_COLUMNS)
    for frame, number, points, *values in rows:
        # Adding zero turns -0.0 into 0.0.
        table.writerow([frame, number, points, *(f"{round(float(value), 4) + 0.0:.4f}" for value in values)])
    write_text(path, text.getvalue())


def write_json(path: Path, data: Any) -> None:
    """Write plain or numpy data as `as_json` has it."""
    write_text(path, as_json(data, indent=2) + "\n")


def write_toml(path: Path, config: Config | RgbdConfig, comment: str = "") -> None:
    """Write every setting, below a `comment`, in a form that can be read back as a settings file."""
    write_text(path, as_toml(config, comment))


def as_toml(config: Config | RgbdConfig, comment: str = "") -> str:
    """Every setting as TOML, below a `comment`."""
    heading = f"# {comment}\n\n" if comment else ""
    return heading + tomli_w.dumps(to_dict(config))


def check_output(option: str, path: Path, suffix: str, inputs: tuple[Path, ...] = ()) -> None:
    """Raise DataError unless `path` may become a file: its kind, its folder, and that it is no input."""
    if path.suffix != suffix:
        raise DataError(f"{option} {path}: expected a file name ending in {suffix}")
    if path.is_dir():
        raise DataError(f"{option} {path}: is a folder; expected a file name")
    if any(path.exists() and file.exists() and path.samefile(file) for file in inputs):
        raise DataError(f"{option} {path}: is the input itself; choose another name")
    check_parents(option, path)


def check_parents(option: str, path: Path) -> None:
    """Raise DataError where a folder above `path` cannot be one, or cannot be written to."""
    nearest = next(parent for parent in path.absolute().parents if os.path.exists(parent))
    if not nearest.is_dir():
        raise DataError(f"{option} {path}: {nearest} is a file; expected a folder")
    if not os.access(nearest, os.W_OK):
        raise DataError(f"{option} {path}: {nearest} cannot be written to; choose another {option}")


def read_archive(path: Path, names: tuple[str, ...]) -> dict[str, np.ndarray]:
    """The arrays of a flow file by their `names`; DataError where it is damaged or lacks one."""
    if not path.is_file():
        found = "is a folder" if path.is_dir() else "no such file"
        raise DataError(f"{path}: {found}; expected a flow file (.npz)")
    if not is_whole(path):
        raise DataError(f"{path}: not an .npz archive, or a truncated one; expected a flow file")
    try:
        return arrays.from_npz(path, names)
    except arrays.MissingArray as error:
        raise DataError(f"{path}: not a flow file, {error}; expected the output of 'lidarflow pair' or "
                        "'lidarflow run'") from None
    except arrays.ERRORS as error:
        raise DataError(f"{path}: not a readable flow file ({one_line(error)})") from None


def as_json(data: Any, indent: int | None = None) -> str:
    """Plain or numpy data as JSON, keys sorted; numbers that are not finite become null."""
    return json.dumps(_plain(data), sort_keys=True, indent=indent, allow_nan=False, ensure_ascii=False)


def _plain(data: Any) -> Any:
    """`data` in the types of JSON."""
    if isinstance(data, dict):
        return {str(key): _plain(value) for key, value in data.items()}
    if isinstance(data, list | tuple):
        return [_plain(value) for value in data]
    if isinstance(data, np.ndarray | np.generic):
        return _plain(data.tolist())
    if isinstance(data, float):
        return data if np.isfinite(data) else None
    return data


def write_text(path: Path, text: str) -> None:
    """Write text as UTF-8."""
    with written_aside(path) as aside:
        aside.write_text(text, encoding="utf-8")


def _joined(row: list[float]) -> str:
    return " ".join(f"{value:.12g}" for value in row)

"""What a data set offers, and the part that all data sets of scan files share."""

import itertools
import re
from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from lidarflow.datasets import clouds
from lidarflow.datasets.kitti_correction import correct_vertical_angle
from lidarflow.datasets.one_by_one import OneByOne
from lidarflow.errors import DataError
from lidarflow.types import Scan, Truth

_PERIOD_NS = 100_000_000     # of 10 Hz
_MOST_APART_S = 10.0     # scans that show the same places; more are times in another unit
_EARLIEST_S, _LATEST_S = 10**8, 9 * 10**9     # what a stamp may be; 64-bit nanoseconds end at 9.2e9 s
TRUTH_ARRAYS = ("flow", "valid", "dynamic", "track", "target_from_source")
_ARRAY_OF = {"ego_motion": "target_from_source", "is_dynamic": "dynamic", "object_id": "track"}


@dataclass(frozen=True, slots=True)
class Source:
    """What `open_dataset` opened a data set with, so that it can be opened again."""

    folder: Path
    loader: str
    sequence: str | None
    kitti_correction: str


class Dataset(Protocol):
    """A sequence of scans from one sensor, in order of time; `for scan in dataset` reads one after the other.

    name    what messages call it, e.g. "kitti 00"
    loader  the name that `open_dataset` knows it by
    note    what was assumed while opening it, "" for nothing
    source  set by `open_dataset`, None for a data set that was made in another way
    """

    name: str
    loader: str
    note: str
    source: Source | None

    def __len__(self) -> int: ...

    def __iter__(self) -> Iterator[Scan]: ...

    def __getitem__(self, index: int) -> Scan:
        """As `scan`, and from the end where `index` is negative."""

    def scan(self, index: int) -> Scan:
        """The scan at `index`, rows in the order of its file; OutOfRangeError where there is none."""

    def truth(self, index: int) -> Truth | None:
        """What happened from the scan at `index` to the one at `index + 1`, where it is known."""

    def world_from_sensor(self) -> np.ndarray | None:
        """Given poses (N, 4, 4) of the sensor, one per scan, where they are known."""


class Scans(OneByOne[Scan]):
    """What every data set of scans is, whoever reads them: `scan` by number, and one by one."""

    item = "scan"

    @abstractmethod
    def scan(self, index: int) -> Scan:
        """The scan at `index`; DataError where there is none or it cannot be read."""

    def _item(self, index: int) -> Scan:
        return self.scan(index)


class ScanFiles(Scans):
    """Scans in one file each; loaders add the truth and the poses that they know of.

    files     in order of time, no two of one name but for suffix and capitals
    times_ns  one per file; None = read from the file names, else 10 Hz
    correct   whether the KITTI vertical-angle correction is applied
    """

    loader = "folder"
    source: Source | None = None

    def __init__(self, name: str, files: Sequence[Path], times_ns: Sequence[int] | None = None,
                 correct: bool = False, notes: Sequence[str] = ()):
        self.name = name
        self.files = list(files)
        clouds.check_names(self.files)
        known_ns = list(times_ns) if times_ns is not None else times_from_names(self.files)
        self.times_ns = known_ns or assumed_times(len(self.files))
        self.correct = correct
        assumed = ["KITTI vertical-angle correction on"] if correct else []
        assumed += [] if known_ns else ["10 Hz assumed"]
        self.note = "; ".join([*assumed, *notes, *_far_apart(known_ns)])

    def __len__(self) -> int:
        return len(self.files)

    def scan(self, index: int) -> Scan:
        """The scan at `index`; DataError where there is none or its file is damaged."""
        points = self.stored_points(index)
        if self.correct:
            points = correct_vertical_angle(points)
        return Scan(points, self.times_ns[index], self.files[index].stem)

    def stored_points(self, index: int) -> np.ndarray:
        """Points (N, 3) of the scan at `index` as its file holds them, without a correction."""
        return self._read(self.files[self.check_index(index)])

    def truth(self, index: int) -> Truth | None:
        """Nothing is known unless a loader says otherwise."""
        return None

    def stored_truth(self, folder: Path, index: int) -> Truth | None:
        """Truth of <scan>.npz in `folder`, where there is such a file and the scan has a successor."""
        if not 0 <= index < len(self) - 1:
            return None
        file = folder / f"{self.files[index].stem}.npz"
        return load_truth(file, self.files[index], self.files[index + 1])

    def world_from_sensor(self) -> np.ndarray | None:
        """No poses unless a loader says otherwise."""
        return None

    def _read(self, file: Path) -> np.ndarray:
        return clouds.read_points(file)


def _far_apart(times_ns: Sequence[int]) -> list[str]:
    """A note where increasing times are so far apart that they may not be what they are taken for."""
    apart_s = float(np.median(np.diff(np.array(times_ns, np.int64)))) * 1e-9 if len(times_ns) > 1 else 0.0
    if apart_s <= _MOST_APART_S:
        return []
    return [f"scans are {apart_s:.6g} s apart by their times; are those seconds?"]


def frame_number(file: Path) -> int | None:
    """The number that a file's stem ends in, e.g. 12 of scan00012.png."""
    digits = re.search(r"\d+$", file.stem)
    return int(digits.group()) if digits else None


def assumed_times(count: int) -> list[int]:
    """Times in ns of `count` scans of which none is known: 10 Hz, from 0 on."""
    return [index * _PERIOD_NS for index in range(count)]


def times_from_names(files: Sequence[Path]) -> list[int]:
    """Times in ns: the file names where all are increasing stamps, else none."""
    times_ns = _stamps(files)
    return times_ns if all(a < b for a, b in itertools.pairwise(times_ns)) else []


def _stamps(files: Sequence[Path]) -> list[int]:
    """Times in ns that files are named by, in nanoseconds or seconds with a point; none where they are not.

    Seconds since 1970 have nine or ten digits; smaller ones may as well be counters.
    """
    if all(re.fullmatch(r"\d{18,19}", file.stem) for file in files):
        return [int(file.stem) for file in files]
    seconds = clouds.seconds_of_names(files)
    if seconds is None or not all(_EARLIEST_S <= time_s < _LATEST_S for time_s in seconds):
        return []
    return [round(time_s.scaleb(9)) for time_s in seconds]     # binary fractions would be 100 ns off


def rows_of_scans(row_count: int, files: Sequence[Path]) -> list[int] | None:
    """Which row of a table with `row_count` rows belongs to each file; None where it cannot be said.

    A table has one row per file, or one per frame of the whole sequence, addressed by frame number.
    """
    if row_count == len(files):
        return list(range(row_count))
    numbers = [number for number in map(frame_number, files) if number is not None]
    if len(numbers) < len(files) or max(numbers) >= row_count:
        return None
    return numbers


def load_truth(file: Path, scan_file: Path, next_file: Path) -> Truth | None:
    """Truth of a scan and its successor from `file`, None where there is no such file.

    A successor whose frame number is not the next one is not the scan the truth speaks of: None.
    Raises DataError for a file that lacks a key or is not aligned with the scan.
    """
    number, following = frame_number(scan_file), frame_number(next_file)
    if not file.is_file() or number is None or following != number + 1:
        return None
    return read_truth(file, len(clouds.read_points(scan_file)), scan_file.name)


def read_truth(file: Path, rows: int, name: str) -> Truth:
    """Truth of a scan called `name` with `rows` points from an .npz file.

    It holds flow (N, 3), valid, dynamic, track (N,) and target_from_source (4, 4), and may hold category
    (numbers of types.Category) and is_ground (N,). Raises DataError where it does not, or is not aligned
    with the scan.
    """
    arrays = clouds.load_arrays(file)
    missing = [key for key in TRUTH_ARRAYS if key not in arrays]
    if missing:
        raise DataError(f"{file}: lacks {', '.join(missing)}; it holds {', '.join(arrays) or 'nothing'}")
    found = len(arrays["flow"]) if arrays["flow"].ndim else 0
    if found != rows:
        raise DataError(f"{file}: {found} rows, but {name} has {rows} points; expected one row per point")
    try:
        return Truth(
            flow=_numbers(arrays, "flow", np.float64),
            ego_motion=_numbers(arrays, "target_from_source", np.float64),
            valid=arrays["valid"],
            is_dynamic=arrays["dynamic"],
            object_id=_numbers(arrays, "track", np.int64),
            category=arrays.get("category"),
            is_ground=arrays["is_ground"] if "is_ground" in arrays else np.zeros(rows, bool),
        )
    except ValueError as error:
        raise DataError(f"{file}: {in_words_of_the_file(error, _ARRAY_OF)}") from None


def in_words_of_the_file(error: ValueError, array_of: Mapping[str, str] | None = None) -> str:
    """What a Truth, or RgbdTruth, says of an attribute, as said of the array in a file that it is made of.

    array_of  the names of the arrays that are not called as the attributes are
    """
    return re.sub(r"^(?:Rgbd)?Truth\.(\w+)", lambda found: f"'{(array_of or {}).get(found[1], found[1])}'",
                  clouds.one_line(error))


def _numbers(arrays: dict[str, np.ndarray], name: str, dtype: type) -> np.ndarray:
    """An array of a truth file as `dtype`; ValueError where it holds no numbers."""
    if arrays[name].dtype.kind not in "fiu":
        raise ValueError(f"'{name}': expected numbers, got {arrays[name].dtype}")
    return arrays[name].astype(dtype)

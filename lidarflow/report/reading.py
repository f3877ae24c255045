"""What the report shows of a run, taken from its folder and from the data that it was made of."""

import csv
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lidarflow import evaluation, flow_files, io, metrics, provenance
from lidarflow.config import Config, load
from lidarflow.datasets.clouds import natural_sorted
from lidarflow.errors import DataError, LidarflowError
from lidarflow.pair_reports import PairReport
from lidarflow.provenance import RunSource
from lidarflow.report import pictures
from lidarflow.report.rebuilding import rebuilt
from lidarflow.types import Scan, ScanPair, Truth

MOST_PICTURED, _MOST_ON_A_PAGE = 6, 12


@dataclass(frozen=True, slots=True)
class Picture:
    """PNG files of one pair; errors is None where its truth is not known."""

    frame: str
    motion: bytes
    errors: bytes | None


@dataclass(frozen=True, slots=True)
class SeenObject:
    """A moving object by its id; means over the pairs it was seen in, nearest_m from the sensor."""

    id: int
    pairs: int
    first_frame: str
    points: float
    nearest_m: float
    size_m: tuple[float, ...]
    speed_m_per_s: float


@dataclass(frozen=True, slots=True)
class Run:
    """One run as the page shows it.

    place      its folder, as it was given
    mean, std  figures of metrics.json by name, over pairs
    three_way, bucketed, by_range, by_speed   over the points of all pairs; None or empty where not known
    note       what the pictures lack and why, "" for nothing
    """

    place: str
    source: RunSource
    config: Config
    truth: str
    mean: dict[str, float]
    std: dict[str, float]
    three_way: metrics.ThreeWay | None
    bucketed: metrics.Bucketed | None
    by_range: tuple[metrics.Interval, ...]
    by_speed: tuple[metrics.Interval, ...]
    pairs: tuple[PairReport, ...]
    objects: tuple[SeenObject, ...]
    pictures: tuple[Picture, ...]
    note: str


def shown_per_run(runs: int) -> int:
    """How many pairs of each of so many runs are pictured, so that the page stays small."""
    return max(1, min(MOST_PICTURED, _MOST_ON_A_PAGE // max(1, runs)))


def read_run(run_dir: Path, most_pictured: int = MOST_PICTURED) -> Run:
    """What there is to show of a run, with pictures of at most so many pairs, evenly chosen.

    Raises DataError for a folder that is no run, and for files that are missing or damaged. Data that are not
    at hand any more only cost the error maps.
    """
    found = read_metrics(run_dir)
    source, config = provenance.read(run_dir), load(run_dir / io.CONFIG_FILE)
    figures = figures_of(found, run_dir)
    pairs, file = figures["pairs"], run_dir / io.METRICS_FILE
    if len(pairs) != len(source.pairs):
        raise DataError(f"{file}: {len(pairs)} pairs, but {io.SOURCE_FILE} names the scans of "
                        f"{len(source.pairs)}; run again")
    numbers = evenly_chosen(len(pairs), most_pictured)
    drawn, note = _pictures(run_dir, pairs, numbers)
    return Run(str(run_dir), source, config, **figures, objects=_read_objects(run_dir / io.OBJECTS_FILE),
               pictures=drawn, note=note)


def figures_of(found: dict, run_dir: Path) -> dict:
    """What was `found` in metrics.json of a run folder, by the names that `Run` has; DataError if damaged."""
    file = run_dir / io.METRICS_FILE
    try:
        return {
            "pairs": rebuilt(tuple[PairReport, ...], found["pairs"], "pairs"),
            "truth": rebuilt(str, found["truth"], "truth"),
            "mean": rebuilt(dict[str, float], found["mean"], "mean"),
            "std": rebuilt(dict[str, float], found["std"], "std"),
            "three_way": rebuilt(metrics.ThreeWay | None, found.get("three_way"), "three_way"),
            "bucketed": rebuilt(metrics.Bucketed | None, found.get("bucketed"), "bucketed"),
            "by_range": rebuilt(tuple[metrics.Interval, ...], found.get("by_range", []), "by_range"),
            "by_speed": rebuilt(tuple[metrics.Interval, ...], found.get("by_speed", []), "by_speed")}
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise DataError(f"{file}: damaged, or of another version ({type(error).__name__}: {error}); "
                        f"write it anew with 'lidarflow eval {run_dir}', or run again") from None


def evenly_chosen(count: int, most: int) -> list[int]:
    """At most `most` of the numbers below `count`, from first to last; the middle one for `most` = 1."""
    # Rounded, not cut off as in rows.spread: where few are chosen, uneven steps show.
    if most == 1:
        return [count // 2]
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int)).tolist()


def read_metrics(run_dir: Path) -> dict:
    """metrics.json of a run folder; DataError where the folder is no run, or the file cannot be read."""
    if not run_dir.is_dir():
        what = "is a file" if run_dir.exists() else "no such folder"
        raise DataError(f"{run_dir}: {what}; expected a folder that 'lidarflow run' wrote")
    file = run_dir / io.METRICS_FILE
    try:
        found = json.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        if (run_dir / io.FLOW_FOLDER).is_dir():
            raise DataError(f"{run_dir}: a run without {io.METRICS_FILE}; was it cut short? write it with "
                            f"'lidarflow eval {run_dir}', or run again") from None
        raise DataError(f"{run_dir}: no {io.METRICS_FILE}; expected a folder that 'lidarflow run' wrote"
                        ) from None
    except (OSError, ValueError, RecursionError) as error:
        raise DataError(f"{file}: damaged ({error}); write it anew with 'lidarflow eval {run_dir}', or run "
                        "again") from None
    if not isinstance(found, dict):
        raise DataError(f"{file}: damaged, holds no object; run again")
    return found


def _pictures(run_dir: Path, pairs: tuple[PairReport, ...], numbers: list[int]
              ) -> tuple[tuple[Picture, ...], str]:
    """Pictures of the pairs with these numbers, and why something is missing from them."""
    files = {file.stem: file for file in natural_sorted((run_dir / io.FLOW_FOLDER).glob("*.npz"))}
    drawn = []
    known, reason = _known_pairs(run_dir, numbers)
    for number, (pair, truth) in zip(numbers, known, strict=True):
        frame = pairs[number].frame
        if frame not in files:
            raise DataError(f"{run_dir}: no flow of scan {frame} in {io.FLOW_FOLDER}; was the run cut short? "
                            "run it again")
        if pair is not None and pair.source.name != frame:
            raise DataError(f"{run_dir / io.METRICS_FILE}: pair {number} is of scan {frame}, but that of the "
                            f"data is of {pair.source.name}; run again")
        scored = pairs[number].scores is not None     # what was no truth for scores is none for a picture
        drawn.append(_picture(files[frame], frame, pair, truth if scored else None))
    if reason:
        return tuple(drawn), f"No error maps, and arrows drawn as if scans were 0.1 s apart: {reason}."
    if all(picture.errors is None for picture in drawn):
        return tuple(drawn), "No error maps: the data set has no truth."
    return tuple(drawn), ""


def _known_pairs(run_dir: Path, numbers: list[int]
                 ) -> tuple[list[tuple[ScanPair | None, Truth | None]], str]:
    """Pairs and their truth from the data set; none, and the reason, where it cannot be read."""
    try:
        return list(evaluation.known_pairs(run_dir, numbers)), ""
    except (LidarflowError, OSError) as error:
        return [(None, None)] * len(numbers), str(error)


def _read_objects(file: Path) -> tuple[SeenObject, ...]:
    """Moving objects of a run, those seen in most pairs first; none where there is no such file."""
    sightings: dict[int, list[dict[str, str]]] = {}
    try:
        with file.open(encoding="utf-8", newline="") as opened:
            for row in csv.DictReader(opened):
                sightings.setdefault(int(row["id"]), []).append(row)
        found = [_object(number, rows) for number, rows in sightings.items()]
    except FileNotFoundError:
        return ()
    except (OSError, ValueError, KeyError, TypeError, csv.Error) as error:
        raise DataError(f"{file}: damaged ({type(error).__name__}: {error}); run again") from None
    return tuple(sorted(found, key=lambda seen: (-seen.pairs, seen.id)))


def _object(number: int, rows: list[dict[str, str]]) -> SeenObject:
    """What the rows of objects.csv with one id say together."""
    def mean(*names: str) -> tuple[float, ...]:
        return tuple(float(np.mean([float(row[name]) for row in rows])) for name in names)

    nearest_m = min(float(np.hypot(float(row["x"]), float(row["y"]))) for row in rows)
    return SeenObject(number, len(rows), rows[0]["frame"], mean("points")[0], nearest_m,
                      mean("length", "width", "height"), mean("speed_m_per_s")[0])


def _picture(file: Path, frame: str, pair: ScanPair | None, truth: Truth | None) -> Picture:
    """The pictures of a flow file; `pair` is None where the scans are not at hand."""
    found = flow_files.load_flow(file)
    try:
        result = found.result()
    except (TypeError, ValueError) as error:
        raise DataError(f"{file}: damaged flow file ({error})") from None
    source = Scan(found.points, name=frame)
    dt_s = 0.1 if pair is None else pair.dt_s
    errors = None if truth is None else pictures.error_png(source, result, truth)
    return Picture(frame, pictures.motion_png(source, result, dt_s), errors)

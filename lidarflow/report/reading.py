"""What the report shows of a run, taken from its folder and from the data that it was made of."""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lidarflow import evaluation, io, metrics, provenance
from lidarflow.config import Config, load
from lidarflow.datasets.clouds import natural_sorted
from lidarflow.errors import DataError, LidarflowError
from lidarflow.provenance import RunSource
from lidarflow.report import pictures
from lidarflow.report.rebuilding import rebuilt
from lidarflow.runner import PairReport
from lidarflow.types import Scan, ScanPair, Truth

MOST_PICTURED, _MOST_ON_A_PAGE = 6, 12


@dataclass(frozen=True, slots=True)
class Picture:
    """PNG files of one pair; errors is None where its truth is not known."""

    frame: str
    motion: bytes
    errors: bytes | None


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
    found = _read_metrics(run_dir)
    source, config = provenance.read(run_dir), load(run_dir / io.CONFIG_FILE)
    file = run_dir / io.METRICS_FILE
    try:
        pairs = rebuilt(tuple[PairReport, ...], found["pairs"], "pairs")
        known = {
            "truth": rebuilt(str, found["truth"], "truth"),
            "mean": rebuilt(dict[str, float], found["mean"], "mean"),
            "std": rebuilt(dict[str, float], found["std"], "std"),
            "three_way": rebuilt(metrics.ThreeWay | None, found.get("three_way"), "three_way"),
            "bucketed": rebuilt(metrics.Bucketed | None, found.get("bucketed"), "bucketed"),
            "by_range": rebuilt(tuple[metrics.Interval, ...], found.get("by_range", []), "by_range"),
            "by_speed": rebuilt(tuple[metrics.Interval, ...], found.get("by_speed", []), "by_speed")}
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(f"{file}: damaged, or of another version ({type(error).__name__}: {error}); "
                        f"write it anew with 'lidarflow eval {run_dir}', or run again") from None
    if len(pairs) != len(source.scans) - 1:
        raise DataError(f"{file}: {len(pairs)} pairs, but {io.SOURCE_FILE} names {len(source.scans)} scans; "
                        "run again")
    numbers = evenly_chosen(len(pairs), most_pictured)
    drawn, note = _pictures(run_dir, pairs, numbers)
    return Run(str(run_dir), source, config, **known, pairs=pairs, pictures=drawn, note=note)


def evenly_chosen(count: int, most: int) -> list[int]:
    """At most `most` of the numbers below `count`, from first to last; the middle one for `most` = 1."""
    if most == 1:
        return [count // 2]
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int)).tolist()


def _read_metrics(run_dir: Path) -> dict:
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
    drawn, reasons = [], []
    known = _as_far_as_known(run_dir, numbers, reasons)
    for number in numbers:
        frame = pairs[number].frame
        if frame not in files:
            raise DataError(f"{run_dir}: no flow of scan {frame} in {io.FLOW_FOLDER}; was the run cut short? "
                            "run it again")
        pair, truth = next(known, (None, None))
        drawn.append(_picture(files[frame], frame, pair, truth))
    if reasons:
        reasons = [f"No error maps, and arrows taken for scans 0.1 s apart: {reasons[0]}."]
    elif all(picture.errors is None for picture in drawn):
        reasons = ["No error maps: the data set has no truth."]
    return tuple(drawn), "".join(reasons)


def _as_far_as_known(run_dir: Path, numbers: list[int], reasons: list[str]
                     ) -> Iterator[tuple[ScanPair, Truth | None]]:
    """Pairs and truth from the data set; ends early, with the reason added, where it cannot be read."""
    try:
        yield from evaluation.known_pairs(run_dir, numbers)
    except (LidarflowError, OSError) as error:
        reasons.append(str(error))


def _picture(file: Path, frame: str, pair: ScanPair | None, truth: Truth | None) -> Picture:
    """The pictures of a flow file; `pair` is None where the scans are not at hand."""
    found = io.load_flow(file)
    try:
        result = found.result()
    except (TypeError, ValueError) as error:
        raise DataError(f"{file}: damaged flow file ({error})") from None
    source = Scan(found.points, name=frame)
    dt_s = 0.1 if pair is None else pair.dt_s
    errors = None if truth is None else pictures.error_png(source, result, truth)
    return Picture(frame, pictures.motion_png(source, result, dt_s), errors)

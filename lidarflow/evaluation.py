"""Scores of results on disk: a run folder or a flow file, against its data set's truth or a given one."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lidarflow import flow_files, io, metrics, pair_reports, provenance
from lidarflow.config import Config, load
from lidarflow.datasets import Dataset, Source
from lidarflow.datasets.base import read_truth
from lidarflow.datasets.clouds import natural_sorted
from lidarflow.errors import DataError
from lidarflow.pair_reports import PairReport
from lidarflow.provenance import RunSource
from lidarflow.settings import updated
from lidarflow.types import FlowResult, Scan, ScanPair, Truth

_UNKNOWN = float("nan")
_SAME_POINT_M = 1e-3
_SAME_CRISPNESS = 1e-4
_NAMED = 3     # how many of several names a message shows


@dataclass(frozen=True, slots=True)
class Evaluation:
    """Scores of results: one report per pair, and what they were made with.

    truth_place  where the truth is, for people
    notes        what the figures lack, and why
    """

    reports: list[PairReport]
    config: Config
    truth_place: str
    notes: tuple[str, ...] = ()

    @property
    def truth(self) -> str:
        """What the pairs were scored against."""
        return pair_reports.truth_of([report.truth for report in self.reports])

    def metrics(self) -> dict:
        """What metrics.json holds."""
        return pair_reports.metrics_of(self.reports, self.config)


def evaluate_run(run_dir: Path, truth: Path | None = None, data: Path | None = None) -> Evaluation:
    """Scores of all pairs of a run folder.

    truth  a folder of <scan>.npz files (or one such file, for a run of one pair) to use instead of what the
           data set has
    data   where the run's data set is now, if not where it was

    With a `truth` the data set need not be at hand. The crispness of pairs whose target is no other pair's
    source is then what the run recorded; the notes say so, or that it is not known.

    Raises DataError where a scan lacks its flow or its truth, a file belongs to another cloud, or there is no
    truth at all.
    """
    source, config = provenance.read(run_dir), load(run_dir / io.CONFIG_FILE)
    files = natural_sorted((run_dir / io.FLOW_FOLDER).glob("*.npz"))
    if not files:
        raise DataError(f"{run_dir}: no flow files in {io.FLOW_FOLDER}; was the run cut short? run it again")
    dataset, notes = _opened(source.dataset, data, needed=truth is None, run_dir=run_dir), ()
    if dataset is None:
        if len(files) != len(source.pairs):
            raise DataError(f"{run_dir}: {len(files)} flow files for {len(source.pairs)} pairs; "
                            "was the run cut short? run it again")
        following, recorded = _following(files, source), _recorded(run_dir, config)
        reports = [_from_files(file, after, truth, len(files), config, recorded.get(file.stem))
                   for file, after in zip(files, following, strict=True)]
        alone = [file.stem for file, after in zip(files, following, strict=True) if after is None]
        notes = tuple(_notes_on_crispness(alone, recorded, source))
    else:
        reports = list(_from_dataset(run_dir, files, dataset, source, truth, config))
    place = str(truth) if truth is not None else str(dataset.source.folder)
    _check_truths(place, reports)
    return Evaluation(reports, config, place, notes)


def evaluate_file(file: Path, truth: Path | None) -> Evaluation:
    """Scores of one flow file against a truth file (or a folder with one of the same name).

    Raises DataError for files that cannot be read, of different length, or without truth.
    """
    config = updated(Config(), flow_files.load_flow(file).config, str(file))
    if truth is None:
        raise DataError(f"{file}: a flow file alone has no truth; give --truth FILE.npz, "
                        "or evaluate the folder of its run")
    return Evaluation([_from_files(file, None, truth, 1, config)], config, str(truth))


def known_pairs(run_dir: Path, numbers: Sequence[int]) -> Iterator[tuple[ScanPair, Truth | None]]:
    """The pairs of a run with these numbers, 0 = its first, and what their data set knows of them.

    Raises DataError where the data are not at hand, or are not those of the run.
    """
    source = provenance.read(run_dir)
    if source.dataset is None:
        raise DataError("the run was not made from a data folder")
    if not source.dataset.folder.exists():
        raise DataError(f"{source.dataset.folder} is not there any more")
    dataset = _opened(source.dataset, None, needed=True, run_dir=run_dir)
    _check_length(dataset, source.scans, run_dir)
    for number in numbers:
        index, following = source.pairs[number]
        pair = ScanPair(dataset.scan(index), dataset.scan(following))
        file = run_dir / io.FLOW_FOLDER / f"{pair.source.name}.npz"
        _check_points(file, flow_files.load_flow(file).points, pair.source, dataset)
        yield pair, pair_reports.find_truth(dataset, index, pair)[0]


def _opened(source: Source | None, data: Path | None, needed: bool, run_dir: Path) -> Dataset | None:
    """The data set of a run; None where it is not at hand and not needed either."""
    at_hand = data is not None or (source is not None and source.folder.exists())
    if not at_hand and not needed:
        return None
    if not at_hand and source is None:
        raise DataError(f"{run_dir}: was not made from a data folder; give --truth FOLDER")
    return provenance.opened(run_dir, source, data, ", or --truth")


def _from_dataset(
    run_dir: Path, files: list[Path], dataset: Dataset, run: RunSource, truth: Path | None, config: Config,
) -> Iterator[PairReport]:
    """A report for every pair that the run went through, scans read once each."""
    _check_length(dataset, run.scans, run_dir)
    sources, recorded = {index for index, _ in run.pairs}, _recorded(run_dir, config)
    left = {file.stem: file for file in files}
    last, target = None, None
    for index, following in run.pairs:
        source, target = target if index == last else dataset.scan(index), dataset.scan(following)
        last = following
        file = left.pop(source.name, None)
        if file is None:
            raise DataError(f"{run_dir}: no flow of scan {source.name} ({len(files)} flow files for "
                            f"{len(run.pairs)} pairs); was the run cut short? run it again")
        points, result = _read(file)
        _check_points(file, points, source, dataset)
        if truth is None:
            known, origin = pair_reports.find_truth(dataset, index, ScanPair(source, target))
        else:
            known = _given_truth(truth, source.name, len(source), len(run.pairs))
            origin = known.origin
        alignment = metrics.alignment(source, target, result, config.crispness.sigma_m)
        if following not in sources:
            _check_target(run_dir, dataset, source, target, alignment, recorded.get(source.name))
        yield pair_reports.report_result(source, result, None, alignment, known, origin)
    if left:
        raise DataError(f"{run_dir}: flow of {_some(sorted(left))}, which is no scan of {dataset.name} "
                        "that the run went through; is this the data of the run?")


def _following(files: list[Path], run: RunSource) -> list[Path | None]:
    """For every pair's flow file that of its target scan; None at the end, and before a gap."""
    file_of = {index: file for (index, _), file in zip(run.pairs, files, strict=True)}
    return [file_of.get(following) for _, following in run.pairs]


def _recorded(run_dir: Path, config: Config) -> dict[str, metrics.Alignment]:
    """Crispness by scan that metrics.json has of a run; none where it is missing, damaged or of another σ."""
    found = {}
    try:
        for pair in json.loads((run_dir / io.METRICS_FILE).read_text(encoding="utf-8"))["pairs"]:
            values = metrics.Alignment(**pair["alignment"])
            if values.sigma_m == config.crispness.sigma_m and np.isfinite(values.after):
                found[pair["frame"]] = values
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return {}     # eval is what writes a damaged file anew
    return found


def _notes_on_crispness(
    alone: list[str], recorded: dict[str, metrics.Alignment], run: RunSource
) -> Iterator[str]:
    """What is said of the pairs from the scans `alone`, whose next scan is not at hand."""
    place = "not at hand" if run.dataset is None else f"in {run.dataset.folder}, which is gone"
    kept = [name for name in alone if name in recorded]
    if kept:
        yield f"crispness of {_some(kept)} is what the run recorded: the next scan is {place}"
    unknown = [name for name in alone if name not in recorded]
    if unknown:
        yield f"crispness of {_some(unknown)} is not known, and no part of the mean: the next scan is {place}"


def _from_files(
    file: Path, following: Path | None, truth: Path, pairs: int, config: Config,
    recorded: metrics.Alignment | None = None,
) -> PairReport:
    """A report without the data set: the target is the cloud of the `following` flow file, if any.

    Without, the crispness is what was `recorded`.
    """
    points, result = _read(file)
    source = Scan(points, name=file.stem)
    known = _given_truth(truth, source.name, len(source), pairs)
    unknown = metrics.Alignment(_UNKNOWN, _UNKNOWN, _UNKNOWN, config.crispness.sigma_m)
    alignment = recorded or unknown
    if following is not None:
        target = Scan(flow_files.load_flow(following).points, name=following.stem)
        alignment = metrics.alignment(source, target, result, config.crispness.sigma_m)
    return pair_reports.report_result(source, result, None, alignment, known, known.origin)


def _read(file: Path) -> tuple[np.ndarray, FlowResult]:
    """The source cloud's points (N, 3) and the answer in a flow file."""
    found = flow_files.load_flow(file)
    try:
        return found.points, found.result()
    except (TypeError, ValueError) as error:
        raise DataError(f"{file}: damaged flow file ({error})") from None


def _given_truth(place: Path, name: str, rows: int, pairs: int) -> Truth:
    """Truth of the scan called `name`, with `rows` points: `place` itself, or a file of that name in it."""
    if place.is_dir():
        file = place / f"{name}.npz"
        if not file.is_file():
            found = len(list(place.glob("*.npz")))
            raise DataError(f"{place}: no {file.name}, the truth of scan {name} ({found} other .npz files); "
                            "expected one for every scan with a flow")
        return read_truth(file, rows, name)
    if not place.is_file():
        raise DataError(f"{place}: no such file or folder; expected the truth of {name}")
    if pairs > 1:
        raise DataError(f"{place}: the truth of one scan for {pairs} pairs; "
                        "give a folder with <scan>.npz for each")
    return read_truth(place, rows, name)


def _check_length(dataset: Dataset, scans: tuple[int, ...], run_dir: Path) -> None:
    """Raise DataError unless a data set has all scans that a run went through."""
    if max(scans) >= len(dataset):
        raise DataError(f"{dataset.name}: {len(dataset)} scans, but {run_dir} goes up to scan {max(scans)}; "
                        "is this the data of the run?")


def _check_points(file: Path, points: np.ndarray, scan: Scan, dataset: Dataset) -> None:
    """Raise DataError unless a flow file's points (N, 3) are those of the scan."""
    if len(points) != len(scan):
        raise DataError(f"{file}: {len(points)} points, but scan {scan.name} of {dataset.name} has "
                        f"{len(scan)}; is this the data of the run?")
    apart_m = np.linalg.norm(points - scan.points, axis=1)
    if np.nanmax(apart_m, initial=0.0) > _SAME_POINT_M:
        raise DataError(f"{file}: its points are not those of scan {scan.name} of {dataset.name}, "
                        f"up to {np.nanmax(apart_m):.3g} m apart; is this the data of the run?")


def _check_target(
    run_dir: Path, dataset: Dataset, source: Scan, target: Scan, found: metrics.Alignment,
    recorded: metrics.Alignment | None,
) -> None:
    """Raise DataError where a target that no flow file has the points of is another than the run had."""
    if recorded is not None and abs(found.before - recorded.before) > _SAME_CRISPNESS:
        raise DataError(
            f"{dataset.name}: scan {target.name} is not the one that the flow of {source.name} leads to: "
            f"crispness before any motion is {found.before:.4f}, not {recorded.before:.4f} as in "
            f"{run_dir / io.METRICS_FILE}; is this the data of the run? without that file it is not compared")


def _check_truths(place: str, reports: list[PairReport]) -> None:
    """Raise DataError where there is no truth, or only some pairs have one of their own."""
    without = [report.frame for report in reports if report.scores is None]
    if len(without) == len(reports):
        raise DataError(f"{place}: no truth (neither flow, nor boxes and poses, nor poses); give --truth")
    lacking = without or [reports[k].frame for k in pair_reports.poorer([report.truth for report in reports])]
    if lacking:
        raise DataError(f"{place}: no truth of {_some(lacking)}, but of the other scans; "
                        "get the missing truth, or run without these scans")


def _some(names: list[str]) -> str:
    """The first names, and how many there are."""
    shown = ", ".join(names[:_NAMED])
    return shown if len(names) <= _NAMED else f"{shown}, … ({len(names)} in all)"

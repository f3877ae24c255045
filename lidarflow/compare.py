"""Several methods on the same scans, scored on the same points."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from lidarflow import methods, metrics, pair_reports
from lidarflow.config import Config
from lidarflow.datasets import Dataset
from lidarflow.errors import ConfigError, LidarflowError
from lidarflow.lidar import features
from lidarflow.settings import to_dict
from lidarflow.types import FlowResult, ScanPair, Truth


@dataclass(slots=True)
class MethodRun:
    """A method on its way through the scans.

    figures  of every pair: by name, units in the name
    seconds  of every pair: wall time; the first pair bears the work on both its scans
    """

    name: str
    figures: list[dict[str, float]] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)

    def mean(self) -> dict[str, float]:
        """Means over pairs; a figure leaves out pairs without a value, and is left out where all are."""
        return {name: mean for name, (mean, _) in metrics.figures_over_frames(self.figures).items()}

    def median_seconds(self) -> float:
        """Median over pairs."""
        return float(np.median(self.seconds))


@dataclass(frozen=True, slots=True)
class Comparison:
    """What every method made of the same pairs.

    frames  names of the source scans
    truth   what each pair was scored against
    config  the settings of all methods
    """

    runs: list[MethodRun]
    frames: list[str]
    truth: list[str]
    config: Config

    def to_dict(self) -> dict:
        """Plain values for JSON."""
        return {
            "config": to_dict(self.config),
            "frames": self.frames,
            "truth": self.truth,
            "methods": {
                run.name: {"mean": run.mean(), "median_seconds": run.median_seconds(),
                           "pairs": run.figures, "seconds": run.seconds} for run in self.runs},
        }


def names_of(text: str) -> list[str]:
    """The methods in a list such as "ours,icp", each once; ConfigError for an unknown one, or none."""
    names = list(dict.fromkeys(name.strip() for name in text.split(",") if name.strip()))
    if not names:
        raise ConfigError(f"--methods '{text}': names no method; known are {', '.join(methods.METHODS)}")
    for name in names:
        methods.find(name)
    return names


def compare(
    dataset: Dataset, frames: list[int], names: list[str], config: Config,
    on_pair: Callable[[str], None] = lambda frame: None,
) -> Comparison:
    """Run methods in turn on every consecutive pair of `frames`; `on_pair` hears of every finished pair.

    The first pair is processed beforehand as well, unmeasured, so that compiling and imports are not counted.
    Raises LidarflowError where a method fails, and says which and where.
    """
    for _ in _pairs(dataset, frames[:2], [MethodRun(name) for name in names], config):
        pass
    runs = [MethodRun(name) for name in names]
    found = Comparison(runs, [], [], config)
    for index, pair, results in _pairs(dataset, frames, runs, config):
        truth, origin = pair_reports.find_truth(dataset, index, pair)
        above_ground = features.masks(pair.source, config).standing
        for run, result in zip(runs, results, strict=True):
            run.figures.append(figures_of(pair, result, truth, above_ground, config.crispness.sigma_m))
        found.frames.append(pair.source.name)
        found.truth.append(origin)
        on_pair(pair.source.name)
    _leave_out_poorer_truth(found)
    return found


def _leave_out_poorer_truth(found: Comparison) -> None:
    """Leave but crispness of pairs whose truth is poorer than that of others, which is known at the end."""
    for k in pair_reports.poorer(found.truth):
        found.truth[k] = pair_reports.NO_TRUTH
        for run in found.runs:
            run.figures[k] = {"crispness": run.figures[k]["crispness"]}


def _pairs(dataset: Dataset, frames: list[int], runs: list[MethodRun], config: Config):
    """Every pair's first index, the pair, and each run's result; scans are read once for all methods."""
    estimators = [methods.find(run.name).along(config) for run in runs]
    spent_s = np.zeros(len(runs))
    source = None
    for frame in frames:
        target, results = dataset.scan(frame), []
        for k, (run, estimator) in enumerate(zip(runs, estimators, strict=True)):
            begin = time.perf_counter()
            try:
                results.append(estimator.step(target))
            except LidarflowError as error:
                where = f"method {run.name}, scan {frame} of {dataset.name}"
                raise type(error)(f"{error} ({where})") from error
            spent_s[k] += time.perf_counter() - begin
        if source is not None:
            for run, seconds in zip(runs, spent_s.tolist(), strict=True):
                run.seconds.append(seconds)
            spent_s[:] = 0.0
            yield frame - 1, ScanPair(source, target), results
        source = target


def figures_of(
    pair: ScanPair, result: FlowResult, truth: Truth | None, above_ground: np.ndarray, sigma_m: float
) -> dict[str, float]:
    """Scores of one method on one pair, on points that do not depend on the method.

    Crispness is of the points in above_ground (N,), t_e and r_e of those among them that are known to stand
    still; end-point errors are of all points with a known truth.
    """
    points = pair.source.points
    moved = points[above_ground] + result.flow[above_ground]
    figures = {"crispness": metrics.crispness(moved, pair.target.points, sigma_m)}
    if truth is None:
        return figures
    scores = metrics.score(points, result, truth)
    rows = truth.valid & ~truth.is_dynamic & above_ground
    t_e, r_e = metrics.pose_errors(points[rows], result.motions[rows], truth.ego_motion)
    return figures | {
        "epe_static_m": scores.static.mean, "epe_dynamic_m": scores.dynamic.mean, "t_e_m": t_e,
        "r_e_rad": r_e, "movers_found": scores.movers_found, "false_movers": scores.false_movers}

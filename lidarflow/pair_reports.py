"""What is known of a pair once it is done, and what the pairs of a run say together."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np

from lidarflow import metrics, pose
from lidarflow.config import Config
from lidarflow.datasets import Dataset
from lidarflow.types import FlowResult, Scan, ScanPair, SolveStats, Truth

NO_TRUTH = "none"


@dataclass(frozen=True, slots=True)
class PairReport:
    """What is known of one pair once it is done; scores are None where there is no truth.

    matches      None where only the flow file is left, which does not hold them
    valid_share  how many of the points have a motion that rests on evidence
    doubt        why the scan is hardly what the method expects, "" where it may be
    """

    frame: str
    points: int
    graph_points: int
    moving_points: int
    objects: int
    matches: int | None
    alignment: metrics.Alignment
    scores: metrics.Scores | None
    truth: str
    stats: SolveStats
    seconds: dict[str, float]
    valid_share: float = float("nan")
    doubt: str = ""


def report_pair(
    dataset: Dataset, index: int, pair: ScanPair, result: FlowResult, config: Config
) -> PairReport:
    """Scores of a finished pair, the one from the data set's scan `index` to the next."""
    truth, origin = find_truth(dataset, index, pair)
    alignment = metrics.alignment(pair.source, pair.target, result, config.crispness.sigma_m)
    return report_result(pair.source, result, len(result.match_source), alignment, truth, origin)


def report_result(
    source: Scan, result: FlowResult, matches: int | None, alignment: metrics.Alignment,
    truth: Truth | None, origin: str,
) -> PairReport:
    """Scores of the flow of `source`; `origin` says what its truth was made of."""
    return PairReport(
        frame=source.name,
        points=len(source),
        graph_points=int((result.in_graph & result.valid).sum()),
        moving_points=int(result.is_dynamic.sum()),
        objects=len(np.unique(result.object_id[result.object_id >= 0])),
        matches=matches,
        alignment=alignment,
        scores=None if truth is None else metrics.score(source.points, result, truth),
        truth=origin,
        stats=result.stats,
        seconds=result.seconds,
        valid_share=metrics.mean_of(result.valid[np.isfinite(source.points).all(axis=1)]),
        doubt=result.doubt,
    )


def find_truth(dataset: Dataset, index: int, pair: ScanPair) -> tuple[Truth | None, str]:
    """Truth of the pair at `index`, and what it was made of: "flow", "boxes", "poses", … or "none"."""
    truth = dataset.truth(index)
    if truth is not None:
        return truth, truth.origin
    world_from_sensor = dataset.world_from_sensor()
    if world_from_sensor is None:
        return None, NO_TRUTH
    ego_motion = pose.inverse(world_from_sensor[index + 1]) @ world_from_sensor[index]
    truth = metrics.static_truth(pair.source.points, ego_motion)
    return truth, truth.origin


def figures_of(report: PairReport) -> dict[str, float]:
    """The main figures of one pair by name, units in the name."""
    figures = {
        "crispness_before": report.alignment.before,
        "crispness_by_ego": report.alignment.by_ego,
        "crispness_after": report.alignment.after,
        "valid_share": report.valid_share,
        "moving_points": float(report.moving_points),
        "objects": float(report.objects),
    }
    if report.scores is not None:
        figures |= metrics.figures(report.scores)
    return figures


def metrics_of(reports: list[PairReport], config: Config) -> dict:
    """What metrics.json holds; wall times are kept elsewhere, so that equal runs are equal.

    mean, std  of the figures of every pair, over pairs
    three_way, bucketed, by_range, by_speed   over the points of all pairs, where all have one kind of truth
    pairs      what is known of every pair
    """
    spread, whole = _over_pairs(reports), pooled(reports)
    return {
        "crispness_sigma_m": config.crispness.sigma_m,
        "truth": truth_of([report.truth for report in reports]),
        "mean": {name: mean for name, (mean, _) in spread.items()},
        "std": {name: std for name, (_, std) in spread.items()},
        **({} if whole is None else _plain_pooled(whole)),
        "pairs": [_plain_pair(report) for report in reports],
    }


def mean_of(reports: list[PairReport]) -> dict[str, float]:
    """Means over pairs of the main figures; figures without a value in a pair leave that pair out."""
    return {name: mean for name, (mean, _) in _over_pairs(reports).items()}


def pooled(reports: list[PairReport]) -> metrics.Pooled | None:
    """Scores over the points of all pairs; None where a pair has none, or another kind of truth."""
    scored = [report.scores for report in reports if report.scores is not None]
    alike = len(scored) == len(reports) and len({report.truth for report in reports}) == 1
    return metrics.pool(scored) if alike else None


def truth_of(origins: Sequence[str]) -> str:
    """What pairs were scored against, by their truths' origins, e.g. "flow (4 pairs), none (1 pair)"."""
    counts = Counter(origins)
    if len(counts) == 1:
        return origins[0]
    return ", ".join(f"{origin} ({count} pair{'s' if count > 1 else ''})" for origin, count in counts.items())


def poorer(origins: Sequence[str]) -> list[int]:
    """Which pairs have a truth of poses alone while others have a better one; `origins` of their truths.

    Poses take what moves as static, so figures of such pairs are of another kind than those of the others.
    """
    if not set(origins) - {metrics.POSES_ONLY, NO_TRUTH}:
        return []
    return [k for k, origin in enumerate(origins) if origin == metrics.POSES_ONLY]


def without_poorer_truth(reports: list[PairReport]) -> list[PairReport]:
    """The reports, those with a `poorer` truth as if they had none."""
    poor = poorer([report.truth for report in reports])
    return [replace(report, scores=None, truth=NO_TRUTH) if k in poor else report
            for k, report in enumerate(reports)]


def _over_pairs(reports: list[PairReport]) -> dict[str, tuple[float, float]]:
    """Mean and standard deviation of every figure that some pair has a value of."""
    return metrics.figures_over_frames(figures_of(report) for report in reports)


def _plain_pair(report: PairReport) -> dict:
    values = asdict(report)
    del values["seconds"], values["doubt"]
    if values["scores"] is not None:
        del values["scores"]["buckets"]     # sums to be pooled, nothing to be read
    return values


def _plain_pooled(whole: metrics.Pooled) -> dict:
    three_way = {"mean_m": whole.three_way.mean_m, "dynamic_iou": whole.three_way.dynamic_iou}
    return {**asdict(whole), "three_way": {**three_way, **asdict(whole.three_way)}}

"""The pairs of a sequence, one after the other: computed, or taken from what an interrupted run kept."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from lidarflow import io
from lidarflow.checkpoints import Checkpoints
from lidarflow.datasets import Dataset
from lidarflow.errors import LidarflowError
from lidarflow.lidar.tracking import Tracks
from lidarflow.pipeline import Estimator
from lidarflow.types import FlowResult, Scan, ScanPair


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """A finished pair.

    index     int   of its source scan in the data set; its target is the next
    tracks          the objects that are followed after it
    restored  bool  taken from a checkpoint
    """

    index: int
    pair: ScanPair
    result: FlowResult
    tracks: Tracks
    restored: bool


@dataclass(frozen=True, slots=True)
class Skipped:
    """A scan that cannot be used: its index in the data set, and why in one line."""

    index: int
    reason: str


def steps(
    dataset: Dataset, frames: list[int], estimator: Estimator, kept: Checkpoints | None = None,
    on_skip: Callable[[Skipped], None] | None = None,
) -> Iterator[Step]:
    """Every pair of neighbouring scans among `frames`, in order.

    Pairs that are `kept` are not computed again. The estimator is led past them, so that what follows comes
    out as if they had been computed; behind the last missing pair it is not needed any more.

    With `on_skip` a scan that cannot be read or used is left out, and with it both its pairs: `on_skip` hears
    of it, and the estimator begins anew. Without, LidarflowError says which scan it is.
    """
    restorable = kept.found() if kept is not None else frozenset()
    missing = [index for index in frames[:-1] if index not in restorable]
    source: Scan | None = None
    for frame in frames:
        is_known = source is not None and frame - 1 in restorable
        try:
            target = dataset.scan(frame)
            result = None if is_known else estimator.step(target)
        except LidarflowError as error:
            if on_skip is None:
                first = max(frame - 1, frames[0])
                raise type(error)(f"{error} (scans {first} and {first + 1} of {dataset.name})") from error
            on_skip(Skipped(frame, " ".join(str(error).split())))
            estimator.reset()
            source = None
            continue
        if is_known:
            result, tracks = kept.load(frame - 1, ScanPair(source, target))
            if missing and missing[-1] >= frame:
                estimator.follow(target, result, tracks)
            yield Step(frame - 1, ScanPair(source, target), result, tracks, True)
        elif source is not None:
            yield Step(frame - 1, ScanPair(source, target), result, estimator.tracks, False)
        source = target


def saying_what_is_kept(done: Iterator[Step], out: Path) -> Iterator[Step]:
    """`done`; an error on the way also says how much of the run in `out` is there, and how it goes on."""
    count = 0
    try:
        for step in done:
            yield step
            count += 1
    except LidarflowError as error:
        if not count:
            raise
        raise type(error)(f"{error}; the flow of {count} before is kept in {out / io.FLOW_FOLDER}, "
                          "--resume goes on from there and --skip-bad leaves bad scans out") from error

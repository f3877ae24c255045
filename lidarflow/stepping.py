"""The pairs of a sequence, one after the other: computed, or taken from what an interrupted run kept.

Scans and RGB-D frames are gone through alike; a `Walk` says what they are.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from lidarflow import io
from lidarflow.checkpoints import Stretch
from lidarflow.datasets import Dataset
from lidarflow.errors import LidarflowError
from lidarflow.lidar.tracking import Tracks
from lidarflow.pipeline import Estimator
from lidarflow.rgbd_types import RgbdFrame, RgbdPair, RgbdResult
from lidarflow.types import FlowResult, Scan, ScanPair

if TYPE_CHECKING:
    from lidarflow.datasets.rgbd_folders import RgbdFolder
    from lidarflow.rgbd_methods import Estimator as RgbdEstimator


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """A finished pair.

    index     int      of its source scan in the data set; its target is the next
    tracks    Tracks   the objects that are followed after it; None for RGB-D frames
    stretch   Stretch  the scans without a gap that it lies in
    restored  bool     taken from a checkpoint
    """

    index: int
    pair: ScanPair | RgbdPair
    result: FlowResult | RgbdResult
    tracks: Tracks | None
    stretch: Stretch
    restored: bool

    def is_written(self, file: Path) -> bool:
        """Whether its flow file is whole: older than a checkpoint, it may have been cut off since."""
        return self.restored and io.is_whole(file)


class Kept(Protocol):
    """Checkpoints: of which pairs there are, the stretch and the answer of one, and the tracks after it."""

    def found(self) -> frozenset[int]: ...

    def stretch(self, index: int) -> Stretch: ...

    def load(self, index: int, pair: ScanPair | RgbdPair) -> tuple[
        FlowResult | RgbdResult, Tracks | None]: ...


@dataclass(frozen=True, slots=True)
class Walk:
    """What is gone through: a sequence, and who explains it.

    name       str   what messages call the sequence
    what       str   "scans" or "frames"
    read             the scan at an index; LidarflowError where it cannot be used
    pair             two of them, one after the other
    estimator        is shown them one by one
    """

    name: str
    what: str
    read: Callable[[int], Scan | RgbdFrame]
    pair: Callable[..., ScanPair | RgbdPair]
    estimator: "Estimator | RgbdEstimator"

    @classmethod
    def of_scans(cls, dataset: Dataset, estimator: Estimator) -> "Walk":
        """Along the scans of a data set."""
        return cls(dataset.name, "scans", dataset.scan, ScanPair, estimator)

    @classmethod
    def of_frames(cls, folder: "RgbdFolder", estimator: "RgbdEstimator") -> "Walk":
        """Along the RGB-D frames of a folder."""
        return cls(folder.name, "frames", folder.frame, partial(RgbdPair, camera=folder.camera), estimator)


@dataclass(frozen=True, slots=True)
class Skipped:
    """A scan that cannot be used: its index in the data set, and why in one line."""

    index: int
    reason: str


def steps(
    walk: Walk, frames: list[int], kept: Kept | None = None, on_skip: Callable[[Skipped], None] | None = None,
) -> Iterator[Step]:
    """Every pair of neighbouring scans, or frames, among `frames`, in order.

    Pairs that are `kept` are not computed again, but where scans have become usable or unusable before them
    in their stretch, or a number has been given since that theirs might meet. The estimator is led past those
    that are kept, so that what follows comes out as if they had been computed.

    With `on_skip` a scan that cannot be read or used is left out, and with it both its pairs: `on_skip` hears
    of it, and the estimator begins anew. Without, LidarflowError says which scan it is.
    """
    restorable = kept.found() if kept is not None else frozenset()
    estimator, source, stretch = walk.estimator, None, None
    for frame in frames:
        is_known = source is not None and frame - 1 in restorable and kept.stretch(frame - 1) == stretch
        try:
            target = walk.read(frame)
            result = None if is_known else estimator.step(target)
        except LidarflowError as error:
            if on_skip is None:
                first = max(frame - 1, frames[0])
                raise type(error)(f"{error} ({walk.what} {first} and {first + 1} of {walk.name})") from error
            on_skip(Skipped(frame, " ".join(str(error).split())))
            estimator.reset()
            source = None
            continue
        if source is None:
            tracks = estimator.tracks
            stretch = Stretch(frame, 0 if tracks is None else tracks.next_id)
        else:
            pair = walk.pair(source, target)
            if is_known:
                result, tracks = kept.load(frame - 1, pair)
                estimator.follow(target, result, tracks)
            yield Step(frame - 1, pair, result, estimator.tracks, stretch, is_known)
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
                          "--resume goes on from there and --skip-bad leaves bad ones out") from error

"""The shape that all baselines share: scans in, one rigid motion of the whole scan out."""

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from lidarflow import first_use, pose
from lidarflow.config import Config, given
from lidarflow.lidar import features, preparation
from lidarflow.lidar.features import Masks
from lidarflow.lidar.tracking import Tracks
from lidarflow.stopwatch import Stopwatch
from lidarflow.types import FlowResult, Scan, ScanPair, SolveStats

_UNKNOWN = float("nan")


@dataclass(frozen=True, slots=True, eq=False)
class Registered:
    """How the whole scan moves, and from which matches that was found.

    motion        (4, 4) float64   target_from_source
    match_source  (K, 3) float64   metres, source frame
    match_target  (K, 3) float64   metres, target frame
    inliers       int              matches that agree with the motion
    hypotheses    int              motions that were tried
    """

    motion: np.ndarray
    match_source: np.ndarray = field(default_factory=lambda: np.empty((0, 3)))
    match_target: np.ndarray = field(default_factory=lambda: np.empty((0, 3)))
    inliers: int = 0
    hypotheses: int = 0


class WholeScan(ABC):
    """Flow along a sequence, one rigid motion per pair; subclasses say how that is found.

    What is prepared of a scan serves both of the pairs it belongs to.
    """

    name: ClassVar[str]
    variables: ClassVar[int] = 1     # motions that are solved for

    def __init__(self, config: Config | None = None):
        self.config = given(config, Config)
        self.tracks = Tracks()
        self.reset()

    def reset(self) -> None:
        """Begin anew with the next scan."""
        self._timed = Stopwatch()
        self._previous: tuple[Scan, Masks | None] | None = None

    @classmethod
    def estimate(cls, pair: ScanPair, config: Config | None = None) -> FlowResult:
        """Flow from one scan to the next; raises DataError for scans that cannot be used."""
        method = cls(config)
        method.step(pair.source)
        return method.step(pair.target)

    def step(self, scan: Scan) -> FlowResult | None:
        """Flow from the last scan to this one; None for the first, and for one after a scan of no use."""
        previous, self._previous = self._previous, None
        first_use.announce()
        preparation.require_points(scan, self.config.preparation)
        prepared = self._prepare(scan)
        result = None
        if previous is not None:
            pair = ScanPair(previous[0], scan)
            source = previous[1] if previous[1] is not None else self._prepare(pair.source)
            found = self._register(pair, source, prepared)
            # Seconds count from the last answer on, so that the first pair bears both its scans.
            result = self._result(pair.source, source, found, self._timed.seconds)
            self._timed = Stopwatch()
        self._previous = scan, prepared
        return result

    def follow(self, scan: Scan, known: FlowResult | None, tracks: Tracks) -> None:
        """Take the flow to this scan for known; what is needed of the scan is prepared when it is."""
        self._previous = scan, None

    def _prepare(self, scan: Scan) -> Masks:
        """What is needed of one scan."""
        with self._timed("ground"):
            return features.masks(scan, self.config)

    @abstractmethod
    def _register(self, pair: ScanPair, source: Masks, target: Masks) -> Registered:
        """The motion of the source onto the target."""

    def _result(
        self, scan: Scan, prepared: Masks, found: Registered, seconds: dict[str, float]
    ) -> FlowResult:
        """The motion spread over all points; it rests on evidence where the point took part."""
        n = len(scan)
        return FlowResult(
            flow=pose.apply(found.motion, scan.points) - scan.points,
            motions=np.tile(found.motion, (n, 1, 1)),
            valid=prepared.usable,
            in_graph=np.zeros(n, bool),
            is_dynamic=np.zeros(n, bool),
            ego_motion=found.motion,
            stats=self._stats(found),
            seconds=seconds,
            match_source=found.match_source,
            match_target=found.match_target,
            is_ground=prepared.ground,
        )

    def _stats(self, found: Registered) -> SolveStats:
        """Open3D tells neither the iterations nor the energies of an ICP; those of RANSAC are its samples."""
        return SolveStats(
            solver=self.name, variables=self.variables, matches=len(found.match_source), edges=0,
            components=self.variables, solved_components=self.variables, plain_iterations=0,
            robust_iterations=found.hypotheses, plain_initial_error=_UNKNOWN, plain_final_error=_UNKNOWN,
            robust_initial_error=_UNKNOWN, robust_final_error=_UNKNOWN, inliers=found.inliers, stopped={})

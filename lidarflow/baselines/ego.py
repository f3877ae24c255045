"""All points move with the sensor: ego-motion alone, the same that the method itself starts from."""

from dataclasses import dataclass

from lidarflow.baselines.whole_scan import Registered, WholeScan
from lidarflow.lidar import ego, odometry
from lidarflow.lidar.features import Masks
from lidarflow.lidar.tracking import Tracks
from lidarflow.types import FlowResult, Scan


@dataclass(frozen=True, slots=True, eq=False)
class _Prepared(Masks):
    thinned: ego.Thinned


class Ego(WholeScan):
    """Robust point-to-plane registration, along a sequence from the last motion or from KISS-ICP's.

    The settings of section `ego` apply: ego.method = "kiss_icp" with ego.refine = false is KISS-ICP as
    published (Vizzo et al. 2023). Registered, it is the stronger baseline, and shows what the objects and the
    graph add to it.
    """

    name = "ego"

    def reset(self) -> None:
        """Begin anew with the next scan."""
        super().reset()
        self._odometry = odometry.begun(self.config)

    def step(self, scan: Scan) -> FlowResult | None:
        """Flow from the last scan to this one; None for the first, and for one after a scan of no use."""
        if self._previous is None:
            with self._timed("ego-motion"):
                self._odometry.step(scan.points, 0.0)
        return super().step(scan)

    def follow(self, scan: Scan, known: FlowResult | None, tracks: Tracks) -> None:
        """Take the flow to this scan for known; KISS-ICP sees the scan again."""
        odometry.follow(self._odometry, self._previous[0] if self._previous else None, scan, known)
        super().follow(scan, known, tracks)

    def _prepare(self, scan: Scan) -> _Prepared:
        seen = super()._prepare(scan)
        with self._timed("ego-motion"):
            return _Prepared(seen.usable, seen.ground, ego.Thinned.of_scan(scan, self.config))

    def _register(self, pair, source, target) -> Registered:
        with self._timed("ego-motion"):
            guess = self._odometry.step(pair.target.points, pair.dt_s)
            motion = ego.find(source.thinned, target.thinned, guess, self.config.ego)
            self._odometry.found(motion, pair.dt_s)
            return Registered(motion)

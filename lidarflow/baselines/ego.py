"""All points move with the sensor: ego-motion alone, the same that the method itself starts from."""

from dataclasses import replace

import numpy as np

from lidarflow.baselines.whole_scan import Registered, WholeScan
from lidarflow.config import Config
from lidarflow.lidar import ego
from lidarflow.lidar.tracking import Tracks
from lidarflow.types import FlowResult, Scan, ScanPair


class Ego(WholeScan):
    """KISS-ICP along a sequence (Vizzo et al. 2023), refined by robust point-to-plane registration.

    The settings of section `ego` apply: ego.refine = false is KISS-ICP as published. Refined, it is the
    stronger baseline, and shows what the objects and the graph add to it.
    """

    name = "ego"

    def reset(self) -> None:
        """Begin anew with the next scan."""
        super().reset()
        self._odometry = ego.Odometry(self.config)
        self._guess: np.ndarray | None = None

    @classmethod
    def estimate(cls, pair: ScanPair, config: Config | None = None) -> FlowResult:
        """Flow from one scan to the next; two scans alone are registered without KISS-ICP's guess."""
        config = config or Config()
        return super().estimate(pair, replace(config, ego=replace(config.ego, method="registration")))

    def step(self, scan: Scan) -> FlowResult | None:
        """Flow from the last scan to this one; None for the first, and for one after a scan of no use."""
        with self._timed("ego-motion"):
            self._guess = self._odometry.step(scan.points)
        return super().step(scan)

    def follow(self, scan: Scan, known: FlowResult | None, tracks: Tracks) -> None:
        """Take the flow to this scan for known; KISS-ICP sees the scan again."""
        self._odometry.step(scan.points)
        super().follow(scan, known, tracks)

    def _register(self, pair, source, target) -> Registered:
        with self._timed("ego-motion"):
            return Registered(ego.find(
                pair.source.points[source.usable], pair.target.points[target.usable], self._guess,
                self.config.ego))

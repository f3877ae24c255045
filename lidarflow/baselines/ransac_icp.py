"""RANSAC on descriptor matches, then ICP: the paper's second baseline (Dewan et al. 2016, section V)."""

from dataclasses import replace

import numpy as np

from lidarflow.baselines import ransac
from lidarflow.baselines.whole_scan import Registered, WholeScan
from lidarflow.lidar import ego, features, matching, registration
from lidarflow.lidar.features import Features
from lidarflow.types import Scan, ScanPair

_SEED = 0
# Keypoints are matched around where they are, so the gate has to hold the sensor's own motion, as fast as
# the first stage of ICP reaches.
_MIN_GATE_M_PER_S = 40.0
_START_OFF_M = 1.0    # what RANSAC finds is nearer than this: a wider search could only lose it


class RansacIcp(WholeScan):
    """One motion by RANSAC on SHOT matches around unmoved points, then robust point-to-plane ICP.

    Point-to-plane has a third of the errors of point-to-point (scripts/baseline_variants.py). No ego-motion
    is used. Without a consensus among the matches the ICP starts wide, at the identity.
    """

    name = "ransac_icp"

    def _prepare(self, scan: Scan) -> Features:
        with self._timed("features"):
            return features.extract(scan, self.config)

    def _register(self, pair: ScanPair, source: Features, target: Features) -> Registered:
        with self._timed("matching"):
            match_source, match_target = self._matches(pair, source, target)
        with self._timed("ransac"):
            start, inlier, drawn = ransac.rigid_motion(
                match_source, match_target, np.random.default_rng(_SEED))
        with self._timed("registration"):
            found = ego.register(
                source.thinned, target.thinned, start, np.inf if start is None else _START_OFF_M)
        return Registered(
            registration.reproducible(found), match_source, match_target, int(inlier.sum()), drawn)

    def _matches(
        self, pair: ScanPair, source: Features, target: Features
    ) -> tuple[np.ndarray, np.ndarray]:
        """Matched keypoints (K, 3) of the source and (K, 3) of the target, gates around unmoved points."""
        config = self.config.matching
        gate = max(config.max_speed_m_per_s, _MIN_GATE_M_PER_S)
        here = source.keypoints
        matches = matching.Matches(
            here, np.arange(len(here.row)), here.points, target.keypoints, pair.dt_s,
            replace(config, max_speed_m_per_s=gate))
        rows, places = matches.of(here.row)
        return pair.source.points[rows], places

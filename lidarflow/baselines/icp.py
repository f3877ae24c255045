"""Point-to-point ICP of the whole scans from the identity: the paper's first baseline (Besl, McKay 1992)."""

from typing import NamedTuple

import numpy as np

from lidarflow.baselines.whole_scan import Registered, WholeScan
from lidarflow.lidar import registration
from lidarflow.lidar.features import Masks
from lidarflow.types import Scan

_VOXEL_M = 0.2
_MIN_STANDING = 100     # with fewer points above ground than this, the ground is all there is


class Stage(NamedTuple):
    """How far apart corresponding points may be, and what source and target are thinned to, in voxels."""

    reach: float
    source: float
    target: float


# The first stage reaches 4 m, what a vehicle drives in a tenth of a second at 40 m/s, the last 0.25 m. At the
# end the target is the denser cloud: its points are near to the surface between the source's. What else was
# tried: scripts/baseline_variants.py.
STAGES = (Stage(20.0, 2.5, 2.5), Stage(10.0, 1.0, 1.0), Stage(5.0, 1.0, 1.0), Stage(2.5, 1.0, 0.5),
          Stage(1.25, 1.0, 0.5))


class Icp(WholeScan):
    """One motion by point-to-point ICP, coarse to fine, without a start value.

    Ground is left out: its rings travel with the sensor, and where little else is seen they would hold the
    scan where it is.
    """

    name = "icp"

    def _register(self, pair, source, target) -> Registered:
        with self._timed("registration"):
            return Registered(register(_standing(pair.source, source), _standing(pair.target, target),
                                       (pair.source.name, pair.target.name)))


def register(source: np.ndarray, target: np.ndarray, names: tuple[str, str] = ("", "")) -> np.ndarray:
    """target_from_source (4, 4) of points (N, 3) and (M, 3) in metres.

    Raises DataError, which says whose they are (`names`), for too few of them.
    """
    voxel_m = registration.voxel_for(source, _VOXEL_M)
    target_from_source = np.eye(4)
    for stage in STAGES:
        target_from_source = registration.point_to_point(
            registration.thinned(source, stage.source * voxel_m, names[0]),
            registration.thinned(target, stage.target * voxel_m, names[1]),
            stage.reach * voxel_m, target_from_source)
    return registration.reproducible(target_from_source)


def _standing(scan: Scan, masks: Masks) -> np.ndarray:
    """Points (N, 3) of a scan above ground; all of them where hardly any are."""
    standing = masks.standing
    return scan.points[standing if standing.sum() >= _MIN_STANDING else masks.usable]

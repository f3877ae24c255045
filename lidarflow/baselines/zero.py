"""Nothing moves: what any method has to beat."""

from lidarflow import pose
from lidarflow.baselines.whole_scan import Registered, WholeScan


class Zero(WholeScan):
    """Every point stays where it is in the sensor's frame."""

    name = "zero"
    variables = 0

    def _register(self, pair, source, target) -> Registered:
        return Registered(pose.identity())

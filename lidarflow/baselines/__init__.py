"""What one would use instead: a single rigid motion for a whole scan, found in the usual ways."""

from lidarflow.baselines.ego import Ego
from lidarflow.baselines.icp import Icp
from lidarflow.baselines.ransac_icp import RansacIcp
from lidarflow.baselines.whole_scan import WholeScan
from lidarflow.baselines.zero import Zero

__all__ = ["Ego", "Icp", "RansacIcp", "WholeScan", "Zero"]

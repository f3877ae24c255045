"""lidarflow: a rigid motion for every LiDAR point between consecutive scans."""

__version__ = "0.1.0"

"""What one pair's segmentation says about the clusters of the next: B^T."""

import numpy as np

from lidarflow import pose
from lidarflow.kernels import kmeans
from lidarflow.rgbd.clusters import Clusters
from lidarflow.rgbd.pyramid import Level
from lidarflow.rgbd_types import RgbdResult


def carried(previous: RgbdResult, source: Level, clusters: Clusters) -> np.ndarray:
    """B^T (K,) of the clusters of `source`, the frame that was the previous pair's target.

    The previous clusters' centres are moved along; a pixel has the b of the nearest, a cluster the mean of
    its pixels.
    """
    centres = pose.apply(previous.cluster_motions, previous.centres.astype(float)).astype(np.float32)
    before = kmeans.nearest(source.points.reshape(-1, 3), centres)
    label = clusters.labels[0].ravel()
    has_depth = label >= 0
    b = previous.b[before[has_depth]]
    count = len(clusters.centres)
    total = np.bincount(label[has_depth], b, minlength=count)
    return total / np.maximum(np.bincount(label[has_depth], minlength=count), 1)

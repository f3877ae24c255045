"""Geometric clusters: K-Means of the points, its labels at every level, and which clusters touch."""

from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import numpy as np

from lidarflow.kernels import kmeans
from lidarflow.rgbd.pyramid import Level
from lidarflow.rgbd_config import ClustersConfig

_REFERENCE_WIDTH = 320   # pixels; the width that ClustersConfig.touching_m is meant for


@dataclass(frozen=True, slots=True, eq=False)
class Clusters:
    """The clusters of a frame.

    centres  (K, 3) float32         metres, camera frame
    labels   tuple of (H, W) int32  nearest centre of each pixel, level by level, finest first; −1 = none
    touch    (K, K) bool            which clusters touch in space: the connectivity graph G; diagonal True
    """

    centres: np.ndarray
    labels: tuple[np.ndarray, ...]
    touch: np.ndarray


def find(levels: tuple[Level, ...], config: ClustersConfig) -> Clusters:
    """Cluster a frame of at least one depth; centres are found at half the working size."""
    coarse = levels[min(1, len(levels) - 1)].points
    if not coarse[..., 2].any():
        coarse = levels[0].points
    centres = kmeans.centres(
        coarse.reshape(-1, 3), _seeds(coarse, config.count), config.max_rounds, config.tolerance_m)
    labels = tuple(kmeans.nearest(level.points.reshape(-1, 3), centres).reshape(level.points.shape[:2])
                   for level in levels)
    reach_m = config.touching_m * _REFERENCE_WIDTH / levels[0].camera.width
    return Clusters(centres, labels, kmeans.touching(labels[0], levels[0].points, len(centres), reach_m))


def _seeds(points: np.ndarray, count: int) -> np.ndarray:
    """Start centres (K, 3) float32, K ≤ count: the point of median depth of each part of the image."""
    order, starts = _parts(*points.shape[:2], count)
    flat = points.reshape(-1, 3)
    seeds = []
    for start, end in pairwise(starts):
        part = flat[order[start:end]]
        part = part[part[:, 2] > 0]
        if len(part):
            middle = len(part) // 2
            seeds.append(part[np.argpartition(part[:, 2], middle)[middle]])
    return np.array(seeds, np.float32)


@lru_cache(maxsize=8)
def _parts(height: int, width: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Pixel numbers sorted by the part of the image they are in, and where each of `count` parts starts.

    A part is what lies nearest to one of `count` seeds, which are spread evenly from left to right and step
    through as many rows as make the spacings alike.
    """
    steps = int(np.ceil(np.sqrt(count)))
    index = np.arange(count)
    u, v = (index + 1) * width / (count + 1), (index % steps + 1) * height / (steps + 1)
    rows, columns = np.mgrid[:height, :width]
    distance_sq = (columns[..., None] - u) ** 2 + (rows[..., None] - v) ** 2
    part = distance_sq.argmin(axis=-1).ravel()
    return np.argsort(part, kind="stable"), np.searchsorted(np.sort(part), np.arange(count + 1))

"""What the scripts on ego-motion share: pairs of generated scans, and how many of them are wanted."""

import argparse

import numpy as np

from lidarflow import synthetic
from lidarflow.config import Config
from lidarflow.lidar import ego

CONFIG = Config()

# Two scans, and the motion between them, target_from_source (4, 4).
Pair = tuple[ego.Thinned, ego.Thinned, np.ndarray]


def along(
    scene: synthetic.Scene, sensor: synthetic.Sensor, count: int, noise_seed: int, dt_s: float = 0.1
) -> list[Pair]:
    """The `count` pairs of a drive through a scene, scans `dt_s` apart."""
    scans = synthetic.scan_sequence(scene, sensor, count + 1, np.random.default_rng(noise_seed), dt_s)
    thinned = [ego.Thinned.of_scan(scan, CONFIG) for scan, _ in scans]
    return [(source, target, truth.ego_motion)
            for source, target, (_, truth) in zip(thinned, thinned[1:], scans, strict=False)]


def options(about: str, pairs: int) -> argparse.Namespace:
    """How many `seeds` and `pairs` of each the command line asks for; `pairs` if it does not say."""
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seeds", type=int, default=8)
    parser.add_argument("--pairs", type=int, default=pairs)
    return parser.parse_args()

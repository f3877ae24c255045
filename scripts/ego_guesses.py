"""How far first guesses of the ego-motion are off along a sequence, and whether registration ends elsewhere.

    python scripts/ego_guesses.py FOLDER… [--n-scans N]

What is compared with is the motion that registration finds from the last pair's. Metres and degrees, median
and largest over the pairs that have both guesses.
"""

import argparse
from pathlib import Path

import numpy as np

from lidarflow import pose, runner
from lidarflow.config import Config
from lidarflow.datasets import open_dataset
from lidarflow.lidar import ego, odometry


def compared(folder: Path, n_scans: int | None) -> dict[str, np.ndarray]:
    """By what is compared, (N, 2) metres and degrees off."""
    config, dataset = Config(), open_dataset(folder)
    last_motion, kiss_icp = odometry.LastMotion(), odometry.KissIcp(config)
    before, found = None, []
    frames = runner.choose_frames(dataset, 0, n_scans)
    for frame in frames:
        points = dataset.scan(frame).points
        scan = ego.Thinned.of(points, config)
        guess, by_kiss_icp = last_motion.step(points, 0.1), kiss_icp.step(points, 0.1)
        if before is not None:
            motion = ego.find(before, scan, guess, config.ego)
            last_motion.found(motion, 0.1)
            if guess is not None:
                found.append((motion, guess, by_kiss_icp, ego.find(before, scan, by_kiss_icp, config.ego)))
        before = scan
    names = "last motion", "KISS-ICP", "registered from KISS-ICP"
    return {name: np.array([apart(row[0], row[k]) for row in found]) for k, name in enumerate(names, 1)}


def apart(one: np.ndarray, other: np.ndarray) -> tuple[float, float]:
    """Metres and degrees between two motions (4, 4)."""
    return float(pose.translation_distance(one, other)), float(np.degrees(pose.rotation_distance(one, other)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--n-scans", type=int)
    options = parser.parse_args()
    print("| folder | off by | pairs | median m | largest m | median deg | largest deg |")
    print("|---|---|---|---|---|---|---|")
    for folder in options.folders:
        for name, off in compared(folder, options.n_scans).items():
            median, largest = np.median(off, axis=0), off.max(axis=0)
            print(f"| {folder.name} | {name} | {len(off)} | {median[0]:.4f} | {largest[0]:.4f} "
                  f"| {median[1]:.4f} | {largest[1]:.4f} |")


if __name__ == "__main__":
    main()

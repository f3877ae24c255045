"""How good the mesh and the matches of the front end are, before any optimisation.

    python scripts/front_end.py FOLDER… [--n-scans 2] [--config FILE]

For every pair: the share of non-ground points within 40 m that are in mesh components of at least 20
points, and, where the true motion is known, the share of matches within 0.3 m of it.
"""

import argparse
from pathlib import Path

import numpy as np

from lidarflow import config as settings
from lidarflow import pair_reports, pose, runner
from lidarflow.datasets import open_dataset
from lidarflow.lidar import features, frontend, mesh
from lidarflow.types import ScanPair

NEAR_M, LARGE, CLOSE_M = 40.0, 20, 0.3


def meshed_share(points: np.ndarray, kept: np.ndarray, component: np.ndarray) -> float:
    """Share of the kept points within NEAR_M that are in components of at least LARGE points."""
    near = kept & (np.linalg.norm(points, axis=1) <= NEAR_M)
    return float((np.bincount(component)[component][near] >= LARGE).mean())


def evaluate_pair(dataset, index: int, config: settings.Config) -> str:
    """One row of the table: the pair from scan `index` to the next."""
    pair = ScanPair(dataset.scan(index), dataset.scan(index + 1))
    points = pair.source.points
    source, target = (features.extract(scan, config) for scan in (pair.source, pair.target))
    kept = source.standing
    found = mesh.build(points, kept, source.surface, config.mesh, config.normals.radius_m)
    # The gate is centred on the point itself: nothing is known of the motion beforehand.
    graph = frontend.build(points, found, config.graph.thinning_m)
    matches = frontend.matches(
        graph, source.keypoints, target.keypoints, lambda at: pose.identity(len(at)), pair.dt_s,
        config.matching)
    graph = frontend.matched(graph, points, *matches.of(np.flatnonzero(graph.variable >= 0))).problem
    row = [f"{dataset.name} {pair.source.name}", found.method,
           f"{meshed_share(points, kept, found.component):.3f}", str(len(graph.match_index))]
    truth, _ = pair_reports.find_truth(dataset, index, pair)
    if truth is None:
        return "| " + " | ".join([*row, "-"]) + " |"
    variable_rows = np.flatnonzero(np.isin(np.arange(len(points)), np.unique(found.edges)))
    matched = variable_rows[graph.match_index]
    off_m = np.linalg.norm(points[matched] + truth.flow[matched] - graph.match_target, axis=1)
    share = (off_m[truth.valid[matched]] <= CLOSE_M).mean()
    return "| " + " | ".join([*row, f"{share:.3f}"]) + " |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--config", type=Path)
    parser.add_argument("--n-scans", type=int)
    options = parser.parse_args()
    config = settings.load(options.config)
    print(f"| pair | mesh | points in components ≥ {LARGE} | matches | within {CLOSE_M} m |")
    print("|---|---|---|---|---|")
    for folder in options.folders:
        dataset = open_dataset(folder, kitti_correction=config.preparation.kitti_correction)
        for index in runner.choose_frames(dataset, 0, options.n_scans)[:-1]:
            print(evaluate_pair(dataset, index, config))


if __name__ == "__main__":
    main()

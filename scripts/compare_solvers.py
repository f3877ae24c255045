"""The fast solver against gtsam on the same problems: energy, flow and time.

    python scripts/compare_solvers.py FOLDER… [--config FILE …] [--n-scans 2] [--repeat 5] [--threads 2]

Every pair is solved with the defaults, or with every --config given in turn ("defaults" names the defaults).
The problem is the one that the pipeline hands to its solver; both get the very same, after a warm-up. gtsam
is timed once where it takes more than a second, its result being the same every time.
"""

import argparse
import itertools
import time
from pathlib import Path

import numba
import numpy as np

from lidarflow import config as settings
from lidarflow import pipeline, pose, runner, solve
from lidarflow.datasets import open_dataset
from lidarflow.solve import fast, gtsam_lm
from lidarflow.types import ScanPair

COLUMNS = ("pair", "settings", "variables", "matches", "E gtsam", "E fast", "E difference", "flow RMS mm",
           "inliers", "iterations gtsam", "fast", "gtsam s", "fast s", "ratio")


def problem_of(pair: ScanPair, config: settings.Config) -> tuple:
    """What the pipeline hands to its solver: the problem, the solver's settings, the least matches."""
    seen = []

    def remember(*given):
        seen.append(given)
        return solve.solve(*given)

    pipeline.solve, kept = remember, pipeline.solve
    try:
        pipeline.estimate_flow(pair, config)
    finally:
        pipeline.solve = kept
    return seen[0]


def timed(solver, given: tuple, repeat: int) -> tuple:
    """A solver's answer, and the median of its seconds."""
    seconds = []
    while len(seconds) < repeat and (len(seconds) < 1 or max(seconds) < 1.0):
        begin = time.perf_counter()
        answer = solver.solve(*given)
        seconds.append(time.perf_counter() - begin)
    return answer, float(np.median(seconds))


def row(name: str, label: str, given: tuple, repeat: int) -> list[str]:
    """One line of the table."""
    problem = given[0]
    (reference, _, told), gtsam_s = timed(gtsam_lm, given, repeat)
    fast.solve(*given)
    (motions, _, stats), fast_s = timed(fast, given, repeat)
    apart = pose.apply(motions, problem.points) - pose.apply(reference, problem.points)
    rms = np.sqrt((apart**2).sum(axis=1).mean()) if len(apart) else 0.0
    higher = stats.robust_final_error / told.robust_final_error - 1.0 if told.robust_final_error else 0.0
    return [name, label, str(len(problem.points)), str(len(problem.match_index)),
            f"{told.robust_final_error:.4f}", f"{stats.robust_final_error:.4f}", f"{100 * higher:+.4f} %",
            f"{1000 * rms:.3f}", f"{told.inliers} / {stats.inliers}",
            f"{told.plain_iterations} + {told.robust_iterations}",
            f"{stats.plain_iterations} + {stats.robust_iterations}",
            f"{gtsam_s:.3f}", f"{fast_s:.4f}", f"{gtsam_s / fast_s:.0f}"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--config", type=Path, action="append")
    parser.add_argument("--n-scans", type=int, default=2)
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--threads", type=int, default=numba.get_num_threads())
    options = parser.parse_args()
    numba.set_num_threads(options.threads)
    print(f"{options.threads} threads, median of {options.repeat}\n")
    print("| " + " | ".join(COLUMNS) + " |\n" + "|---" * len(COLUMNS) + "|")
    for folder in options.folders:
        for file in options.config or [Path("defaults")]:
            config = settings.load(None if file == Path("defaults") else file)
            dataset = open_dataset(folder, kitti_correction=config.preparation.kitti_correction)
            frames = runner.choose_frames(dataset, 0, options.n_scans)
            for before, after in itertools.pairwise(frames):
                pair = ScanPair(dataset.scan(before), dataset.scan(after))
                name = f"{dataset.name} {pair.source.name}"
                cells = row(name, file.stem, problem_of(pair, config), options.repeat)
                print("| " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()

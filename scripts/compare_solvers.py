"""The fast solver against gtsam on the same problems: energy, flow and time.

    python scripts/compare_solvers.py FOLDER… [--config FILE …] [--n-scans 2] [--repeat 5] [--threads 2]
        [--restart]

Every pair is solved with the defaults, or with every --config given in turn ("defaults" names the defaults).
The problem is the one that the pipeline hands to its solver; both get the very same, after a warm-up. gtsam
is timed once where it takes more than a second, its result being the same every time.

With --restart the table says instead whether answers that differ are minima: both solvers go on from both
answers, with the matches and ties that these keep, until an iteration gains less than 1e-6 of the energy.
"Ends apart" is between gtsam's from its own answer and gtsam's from the fast one.
"""

import argparse
import itertools
import time
from dataclasses import replace
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
RESTARTED = ("pair", "settings", "flow RMS mm", "kept by gtsam alone", "by fast alone",
             *(f"{answer}'s answer {what} by {solver}" for answer in ("gtsam", "fast")
               for solver in ("gtsam", "fast") for what in ("gains", "moves mm")), "ends apart mm")


def problem_of(pair: ScanPair, config: settings.Config) -> tuple:
    """What the pipeline hands to its solver: the problem, the solver's settings, the least matches."""
    seen = []

    def remember(problem, wanted, min_matches):
        if wanted == config.solver:     # refinement has settings of its own
            seen.append((problem, wanted, min_matches))
        return solve.solve(problem, wanted, min_matches)

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


def kept_by(given: tuple, motions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which matches (K,) and ties (M,) are within the truncation."""
    problem, solver, _ = given
    index = problem.match_index
    off_m = pose.apply(motions[index], problem.points[index]) - problem.match_target
    tied = np.zeros(len(problem.points), bool)
    if len(problem.group):
        rows = np.flatnonzero(problem.group >= 0)
        there = pose.from_translation(problem.points[rows])
        tie = problem.group_motions[problem.group[rows]] @ there
        twists = pose.log(pose.inverse(tie) @ motions[rows] @ there)
        tied[rows] = (twists**2).sum(axis=1) <= solver.tie_truncation**2
    return (off_m**2).sum(axis=1) <= solver.truncation_m**2, tied


def restarted(solver, given: tuple, motions: np.ndarray) -> tuple[np.ndarray, float]:
    """Where a solver goes from motions, with what these keep, and what share of the energy it gains."""
    problem, config, _ = given
    matched, tied = kept_by(given, motions)
    group = np.where(tied, problem.group, -1) if len(problem.group) else problem.group
    kept = replace(problem, initial=motions, match_index=problem.match_index[matched],
                   match_target=problem.match_target[matched], group=group)
    found, _, stats = solver.solve(kept, replace(config, relative_tolerance=1e-6, max_iterations=200), 1)
    return found, 1.0 - stats.robust_final_error / stats.plain_initial_error


def restart_row(name: str, label: str, given: tuple) -> list[str]:
    """One line of the table with --restart."""
    problem = given[0]

    def apart_mm(one, other):
        apart = pose.apply(one, problem.points) - pose.apply(other, problem.points)
        return f"{1000 * np.sqrt((apart**2).sum(axis=1).mean()):.3f}"

    answers, ends, cells = [solver.solve(*given)[0] for solver in (gtsam_lm, fast)], [], []
    for motions in answers:
        for solver in (gtsam_lm, fast):
            end, gain = restarted(solver, given, motions)
            ends.append(end)
            cells += [f"{100 * gain:.4f} %", apart_mm(motions, end)]
    by_gtsam, by_fast = (kept_by(given, motions)[0] for motions in answers)
    return [name, label, apart_mm(*answers), str(int((by_gtsam & ~by_fast).sum())),
            str(int((by_fast & ~by_gtsam).sum())), *cells, apart_mm(ends[0], ends[2])]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--config", type=Path, action="append")
    parser.add_argument("--n-scans", type=int, default=2)
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--threads", type=int, default=numba.get_num_threads())
    parser.add_argument("--restart", action="store_true")
    options = parser.parse_args()
    numba.set_num_threads(options.threads)
    columns = RESTARTED if options.restart else COLUMNS
    if not options.restart:
        print(f"{options.threads} threads, median of {options.repeat}\n")
    print("| " + " | ".join(columns) + " |\n" + "|---" * len(columns) + "|")
    for folder in options.folders:
        for file in options.config or [Path("defaults")]:
            config = settings.load(None if file == Path("defaults") else file)
            dataset = open_dataset(folder, kitti_correction=config.preparation.kitti_correction)
            frames = runner.choose_frames(dataset, 0, options.n_scans)
            for before, after in itertools.pairwise(frames):
                pair = ScanPair(dataset.scan(before), dataset.scan(after))
                name = f"{dataset.name} {pair.source.name}"
                given = problem_of(pair, config)
                cells = (restart_row(name, file.stem, given) if options.restart
                         else row(name, file.stem, given, options.repeat))
                print("| " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()

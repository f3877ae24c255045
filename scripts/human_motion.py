"""Scores on a person who moves the arms or the trunk, against one rigid motion for the whole person.

    python scripts/human_motion.py [--scans 9] [--distances 6 8 10] [--interval 0.1] [--set refine.rounds=5]

An HDL-32E that stands still sees each of the four motions of Dewan et al. 2016, section V-D. All scores are
over the person's points: mean and median end-point error, the mean of those that move at 0.5 m/s or more,
and crispness against the person's points in the next scan. At 0.1 s between scans an arm moves by little
more than noise and its own thickness; at 0.3 s, every third turn of the sensor, no single motion does. Rows:

zero            no motion
icp             one rigid motion: point-to-point ICP of the person's points onto those of the next scan, no
                start value
ransac + icp    one rigid motion: RANSAC on the descriptor matches of the person's points, then ICP
dewan2016       the method with configs/dewan2016.toml, features as dense as a person needs (PEOPLE below)
defaults        the method with the defaults, or with what --config and --set say
truth           the true motion: what crispness can reach with these scan lines and this noise
"""

import argparse
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from evaluate import table

from lidarflow import config as settings
from lidarflow import metrics, pose, synthetic
from lidarflow.open3d_import import open3d
from lidarflow.pipeline import FlowEstimator
from lidarflow.synthetic.human_motion import MOTIONS
from lidarflow.types import FlowResult, Scan, Truth

COLUMNS = 2170            # of an HDL-32E that turns ten times a second: a firing every 46.08 µs
DYNAMIC_M_PER_S = 0.5
GATES_M = (1.0, 0.5, 0.25)
PAPER = Path(__file__).parent.parent / "configs" / "dewan2016.toml"
# Keypoints 0.15 m apart are two on a forearm; and no limb is faster than this.
PEOPLE = ("matching.keypoint_voxel_m=0.03", "shot.surface_voxel_m=0.03", "matching.max_speed_m_per_s=6")
Sequence = list[tuple[Scan, Truth | None]]


@dataclass(frozen=True, slots=True, eq=False)
class Person:
    """The person's points in a pair: source (N, 3), their true flow (N, 3), and target (M, 3), metres."""

    rows: np.ndarray
    source: np.ndarray
    flow: np.ndarray
    target: np.ndarray


def person_pairs(sequence: Sequence) -> list[Person]:
    """The person in every pair whose truth is known on both sides."""
    found = []
    for (scan, truth), (next_scan, next_truth) in pairwise(sequence[:-1]):
        rows = np.flatnonzero(truth.object_id >= 0)
        target = next_scan.points[next_truth.object_id >= 0]
        found.append(Person(rows, scan.points[rows], truth.flow[rows], target))
    return found


def icp(source: np.ndarray, target: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Motion (4, 4) of points (N, 3) onto (M, 3), point to point, with gates from coarse to fine."""
    registration = open3d().pipelines.registration
    method = registration.TransformationEstimationPointToPoint()
    criteria = registration.ICPConvergenceCriteria(1e-9, 1e-9, 100)
    motion = start
    for gate_m in GATES_M:
        found = registration.registration_icp(cloud(source), cloud(target), gate_m, motion, method, criteria)
        motion = np.array(found.transformation)
    return motion


def ransac(source: np.ndarray, target: np.ndarray, gate_m: float) -> np.ndarray:
    """Motion (4, 4) that most of the matches source (K, 3) -> target (K, 3) agree on, within `gate_m`."""
    if len(source) < 3:
        return pose.identity()
    registration = open3d().pipelines.registration
    open3d().utility.random.seed(0)
    pairs = open3d().utility.Vector2iVector(np.column_stack([np.arange(len(source))] * 2))
    found = registration.registration_ransac_based_on_correspondence(
        cloud(source), cloud(target), pairs, gate_m,
        registration.TransformationEstimationPointToPoint(), 3, [],
        registration.RANSACConvergenceCriteria(20000, 0.9999))
    return np.array(found.transformation)


def cloud(points: np.ndarray):
    return open3d().geometry.PointCloud(open3d().utility.Vector3dVector(points))


def on_person(result: FlowResult, person: Person) -> tuple[np.ndarray, np.ndarray]:
    """The matches (K, 3), (K, 3) that the method used and that start on the person."""
    place = {tuple(point) for point in person.source}
    mine = np.array([tuple(point) in place for point in result.match_source], bool)
    return result.match_source[mine], result.match_target[mine]


def flows_of(sequence: Sequence, config: settings.Config) -> list[FlowResult]:
    """The method's results along a sequence."""
    estimator = FlowEstimator(config)
    return [result for scan, _ in sequence[:-1] if (result := estimator.step(scan)) is not None]


def sequence_of(motion: str, seed: int, distance_m: float, scans: int, interval_s: float) -> Sequence:
    """Scans of a person who moves, with truth; one more than asked for, so that the last pair has both."""
    rng = np.random.default_rng(seed)
    scene = synthetic.human_motion(motion, rng, distance_m)
    return synthetic.scan_sequence(scene, synthetic.hdl32e(columns=COLUMNS), scans + 1, rng, interval_s)


def measure(sequence: Sequence, config: settings.Config, interval_s: float) -> dict[str, list]:
    """Rows of scores by method, one entry a pair."""
    people = person_pairs(sequence)
    by_the_paper = settings.load(PAPER, PEOPLE)
    paper = flows_of(sequence, by_the_paper)
    ours = flows_of(sequence, config)
    scores: dict[str, list] = {}
    for person, by_paper, by_us in zip(people, paper, ours, strict=True):
        source, target = person.source, person.target
        matched = on_person(by_paper, person)
        start = ransac(*matched, by_the_paper.solver.truncation_m)
        flows = {
            "zero": np.zeros_like(source),
            "icp": pose.apply(icp(source, target, pose.identity()), source) - source,
            "ransac + icp": pose.apply(icp(source, target, start), source) - source,
            "dewan2016": by_paper.flow[person.rows],
            "defaults": by_us.flow[person.rows],
            "truth": person.flow,
        }
        moving = np.linalg.norm(person.flow, axis=1) >= DYNAMIC_M_PER_S * interval_s
        for name, flow in flows.items():
            error = metrics.end_point_error(flow, person.flow)
            scores.setdefault(name, []).append(
                (error.mean(), np.median(error), error[moving].mean() if moving.any() else np.nan,
                 metrics.crispness(source + flow, target, config.crispness.sigma_m)))
    return scores


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--scans", type=int, default=9)
    parser.add_argument("--distances", type=float, nargs="+", default=[6.0, 8.0, 10.0])
    parser.add_argument("--interval", type=float, default=0.1, help="seconds between scans")
    parser.add_argument("--motions", nargs="+", default=list(MOTIONS))
    parser.add_argument("--config", type=Path)
    parser.add_argument("--set", dest="overrides", action="append", default=[])
    options = parser.parse_args()
    config = settings.load(options.config, tuple(options.overrides))
    rows = []
    for name in options.motions:
        scores: dict[str, list] = {}
        for seed, distance_m in enumerate(options.distances):
            sequence = sequence_of(name, seed, distance_m, options.scans, options.interval)
            for method, found in measure(sequence, config, options.interval).items():
                scores.setdefault(method, []).extend(found)
        rows += [[name, method, str(len(found)), *(f"{v:.4f}" for v in np.nanmean(found, axis=0))]
                 for method, found in scores.items()]
    print(table(["motion", "method", "pairs", "mean [m]", "median [m]", "moving [m]", "crispness"], rows))


if __name__ == "__main__":
    main()

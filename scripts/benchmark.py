"""Milliseconds a pair, beside what others take on the same scans, as tables and JSON.

    python scripts/benchmark.py FOLDER… [--pairs 20] [--threads 2] [--growth] [--start] [--json FILE]

Every scan is in memory before the clock starts, every method has run once, and all take turns pair by pair,
so that what else the machine does falls on all. Figures are medians over at least --pairs pairs; short
sequences are run again until there are as many. "ours" is `FlowEstimator.step`, from array to flow; its first
scan, which has no pair, is left out. Beside it, ego-motion alone:

KISS-ICP             register_frame, as it comes (scan to map)
small_gicp GICP      scan to scan, 0.25 m voxels, a start value from the pair before
Open3D ICP           point to plane, 0.2 m voxels, the same start value
Open3D FPFH+RANSAC   features and RANSAC at 0.5 m, then that ICP from what RANSAC finds (--pairs 3 at most)

--growth merges scans into clouds of 15,000 to 500,000 points and fits the exponent of each stage; such clouds
have no rings, so that the mesh is the one of tangent planes. --start times a program of its own from its
begin to the flow of its first pair, less what its second takes: imports, and kernels from the cache. Accuracy
is measured by scripts/evaluate.py, the solvers are compared on equal problems by scripts/compare_solvers.py.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numba
import numpy as np
from evaluate import table

from lidarflow import pose
from lidarflow.config import Config
from lidarflow.datasets import open_dataset
from lidarflow.lidar import preparation
from lidarflow.open3d_import import open3d
from lidarflow.pipeline import FlowEstimator
from lidarflow.types import Scan

SIZES = (15_000, 30_000, 60_000, 120_000, 250_000, 500_000)
MERGED = 5          # scans in a cloud whose growth is measured
SLOW_PAIRS = 3      # of what takes many seconds
VOXEL_M, COARSE_M, REACH_M = 0.2, 0.5, 1.0


def seconds_of(work: Callable, given) -> tuple[float, object]:
    begin = time.perf_counter()
    answer = work(given)
    return time.perf_counter() - begin, answer


class KissIcp:
    """KISS-ICP along a sequence."""

    def __init__(self):
        from kiss_icp.config import KISSConfig
        from kiss_icp.kiss_icp import KissICP

        config = KISSConfig()
        config.data.max_range, config.data.min_range, config.data.deskew = 80.0, 1.5, False
        config.mapping.voxel_size = 0.8
        self._odometry = KissICP(config)

    def step(self, points: np.ndarray) -> None:
        self._odometry.register_frame(points, np.empty(0))


class SmallGicp:
    """small_gicp's GICP from scan to scan."""

    def __init__(self, threads: int):
        self._threads, self._last, self._start = threads, None, np.eye(4)

    def step(self, points: np.ndarray) -> None:
        import small_gicp

        if self._last is not None:
            found = small_gicp.align(
                points, self._last, init_T_target_source=self._start, downsampling_resolution=0.25,
                max_correspondence_distance=REACH_M, num_threads=self._threads)
            self._start = found.T_target_source
        self._last = points


class Open3dIcp:
    """Open3D's point-to-plane ICP from scan to scan, from RANSAC on FPFH features if told so."""

    def __init__(self, by_features: bool):
        self._by_features, self._last, self._start = by_features, None, np.eye(4)

    def step(self, points: np.ndarray) -> None:
        registration = open3d().pipelines.registration
        if self._last is not None:
            if self._by_features:
                self._start = self._ransac(points)
            source, target = (_thinned(cloud, VOXEL_M) for cloud in (self._last, points))
            self._start = registration.registration_icp(
                source, target, REACH_M, self._start,
                registration.TransformationEstimationPointToPlane()).transformation
        self._last = points

    def _ransac(self, points: np.ndarray) -> np.ndarray:
        registration = open3d().pipelines.registration
        search = open3d().geometry.KDTreeSearchParamHybrid(5 * COARSE_M, 100)
        clouds = [_thinned(cloud, COARSE_M) for cloud in (self._last, points)]
        features = [registration.compute_fpfh_feature(cloud, search) for cloud in clouds]
        return registration.registration_ransac_based_on_feature_matching(
            *clouds, *features, True, 1.5 * COARSE_M).transformation


def _thinned(points: np.ndarray, voxel_m: float):
    o3d = open3d()
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points)).voxel_down_sample(voxel_m)
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(5 * voxel_m, 30))
    return cloud


class Ours:
    """FlowEstimator, with its stages."""

    def __init__(self):
        self._estimator, self.stages = FlowEstimator(Config()), []

    def step(self, scan: Scan) -> None:
        result = self._estimator.step(scan)
        if result is not None:
            self.stages.append(result.seconds)


def along(scans: list[Scan], pairs: int, threads: int) -> tuple[dict[str, float], dict[str, float]]:
    """Median milliseconds of every method, and of our stages, along the scans as often as it takes."""
    usable = [scan.points[preparation.usable(scan.points, Config().preparation)] for scan in scans]
    taken: dict[str, list[float]] = {}
    stages: list[dict[str, float]] = []
    rounds = -(-pairs // (len(scans) - 1))
    for number in range(rounds + 1):   # the first warms up
        ours = Ours()
        methods = {"ours": ours, "KISS-ICP": KissIcp(), "small_gicp GICP": SmallGicp(threads),
                   "Open3D ICP": Open3dIcp(False)}
        if number * (len(scans) - 1) <= SLOW_PAIRS:
            methods["Open3D FPFH+RANSAC+ICP"] = Open3dIcp(True)
        for k in range(len(scans)):
            for name, method in methods.items():
                seconds = seconds_of(method.step, scans[k] if method is ours else usable[k])[0]
                # What has no rounds to spare for a warm-up is measured from its second pair on.
                if k > 0 and (number > 0 or (name not in FAST and k > 1)):
                    taken.setdefault(name, []).append(seconds)
        if number > 0:
            stages += ours.stages
    return {name: 1e3 * float(np.median(values)) for name, values in taken.items()}, _median(stages)


FAST = ("ours", "KISS-ICP", "small_gicp GICP", "Open3D ICP")


def _median(stages: list[dict[str, float]]) -> dict[str, float]:
    return {name: 1e3 * float(np.median([row[name] for row in stages])) for name in stages[0]}


def growth(scans: list[Scan], repeat: int) -> dict[int, dict[str, float]]:
    """Median milliseconds of our stages on clouds of SIZES points, merged from consecutive scans."""
    estimator, rng = FlowEstimator(Config()), np.random.default_rng(0)
    steps = [found.ego_motion for scan in scans[:MERGED + 1] if (found := estimator.step(scan))]
    world_from_scan = pose.trajectory(np.stack([pose.inverse(step) for step in steps]))
    found = {}
    for size in SIZES:
        clouds = []
        for first in (0, 1):
            world = [pose.apply(world_from_scan[k], scans[k].points) for k in range(first, first + MERGED)]
            merged = pose.apply(pose.inverse(world_from_scan[first]), np.concatenate(world))
            merged = merged[np.isfinite(merged).all(axis=1)]
            if len(merged) < size:
                return found
            clouds.append(Scan(merged[rng.permutation(len(merged))[:size]], first * 100_000_000))
        stages = []
        for _ in range(repeat + 1):
            pair = FlowEstimator(Config())
            seconds = [seconds_of(pair.step, cloud) for cloud in clouds]
            stages.append(seconds[1][1].seconds | {"whole": seconds[1][0]})
        found[size] = _median(stages[1:])
    return found


FIRST_PAIR = """
import sys, time
begin = time.perf_counter()
from lidarflow import estimate_flow
from lidarflow.datasets import open_dataset
dataset = open_dataset(sys.argv[1])
pair = dataset.scan(0), dataset.scan(1)
estimate_flow(pair)
first = time.perf_counter()
estimate_flow(pair)
print((first - begin) - (time.perf_counter() - first))
"""


def start_s(folder: Path, repeat: int) -> float:
    """Median seconds that a program needs before it can compute, once kernels are compiled."""
    taken = []
    for _ in range(repeat + 1):
        done = subprocess.run([sys.executable, "-c", FIRST_PAIR, str(folder)], capture_output=True, text=True,
                              check=True)
        taken.append(float(done.stdout))
    return float(np.median(taken[1:]))


def exponents(by_size: dict[int, dict[str, float]]) -> dict[str, float]:
    """The exponent of N that fits each stage best, from 60,000 points on: below, fixed costs rule."""
    sizes = [size for size in by_size if size >= 60_000]
    if len(sizes) < 2:
        return {}
    return {name: float(np.polyfit(np.log(sizes), np.log([by_size[s][name] for s in sizes]), 1)[0])
            for name in by_size[sizes[0]]}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--pairs", type=int, default=20)
    parser.add_argument("--threads", type=int, default=numba.get_num_threads())
    parser.add_argument("--growth", action="store_true")
    parser.add_argument("--start", action="store_true")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    numba.set_num_threads(options.threads)
    print(f"{options.threads} threads of {os.cpu_count()} cores\n")
    told: dict = {"threads": options.threads, "folders": {}}
    for folder in options.folders:
        dataset = open_dataset(folder)
        scans = [dataset.scan(k) for k in range(len(dataset))][:options.pairs + 1]
        methods, stages = along(scans, options.pairs, options.threads)
        told["folders"][folder.name] = {
            "scans": len(scans), "points": int(np.median([len(scan) for scan in scans])),
            "methods_ms": methods, "stages_ms": stages}
    folders = told["folders"]
    for title, key in (("method [ms]", "methods_ms"), ("our stage [ms]", "stages_ms")):
        rows = [[name, *(f"{found[key].get(name, np.nan):.0f}" for found in folders.values())]
                for name in next(iter(folders.values()))[key]]
        if key == "methods_ms":
            ratios = [found[key]["ours"] / found[key]["KISS-ICP"] for found in folders.values()]
            rows.append(["ours / KISS-ICP", *(f"{ratio:.2f}" for ratio in ratios)])
            rows.append(["points", *(str(found["points"]) for found in folders.values())])
        print(table([title, *folders], rows), "\n", flush=True)
    if options.growth:
        dataset = open_dataset(options.folders[0])
        by_size = growth([dataset.scan(k) for k in range(min(len(dataset), MERGED + 2))], 3)
        fitted = exponents(by_size)
        rows = [[name, *(f"{by_size[size][name]:.0f}" for size in by_size), f"{fitted.get(name, np.nan):.2f}"]
                for name in by_size[SIZES[0]]]
        print(table(["our stage [ms]", *(f"{size:,}" for size in by_size), "exponent"], rows), "\n")
        told |= {"growth_ms": by_size, "exponents": fitted}
    if options.start:
        told["start_s"] = start_s(options.folders[0], 5)
        print(f"start {told['start_s']:.2f} s\n")
    told["peak_memory_gb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    print(f"peak memory {told['peak_memory_gb']:.2f} GB, of all methods together")
    if options.json:
        options.json.write_text(json.dumps(told, indent=1))


if __name__ == "__main__":
    main()

"""SHOT352 against the Point Cloud Library: agreement and time on the same points, normals and keypoints.

    python scripts/compare_shot.py CLOUD --pcl REFERENCE [--threads 2]

REFERENCE is a program called as `REFERENCE shot POINTS.f32 NORMALS.f32 KEYPOINTS.i32 RADIUS THREADS OUT.f32`
(row-major float32 arrays) that writes PCL's 352 numbers and 9 of the local frame per keypoint, and prints
`seconds=…`.
"""

import argparse
import re
import subprocess
import tempfile
import time
from pathlib import Path

import numba
import numpy as np

from lidarflow.config import Config
from lidarflow.datasets.clouds import read_points
from lidarflow.kernels import grid, normals, shot
from lidarflow.lidar import ground, preparation


def prepared(cloud: Path, config: Config) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Non-ground points (N, 3) as float32 values, their normals (N, 3), and keypoint rows (K,)."""
    points = read_points(cloud)
    usable = preparation.usable(points, config.preparation)
    upright = usable & ~ground.detect(points, usable, config.ground).mask
    points = points[upright].astype(np.float32).astype(float)
    return (points, normals.estimate(points, points, config.normals.radius_m),
            grid.first_per_voxel(points, 2 * config.matching.keypoint_voxel_m))


def pcl_descriptors(program, points, point_normals, keypoints, radius_m, threads):
    """PCL's descriptors (K, 352) and seconds, by the reference program."""
    with tempfile.TemporaryDirectory() as folder:
        names = ("points.f32", "normals.f32", "keypoints.i32", "out.f32")
        paths = [str(Path(folder) / name) for name in names]
        points.astype(np.float32).tofile(paths[0])
        point_normals.astype(np.float32).tofile(paths[1])
        keypoints.astype(np.int32).tofile(paths[2])
        done = subprocess.run([program, "shot", *paths[:3], str(radius_m), str(threads), paths[3]],
                              check=True, capture_output=True, text=True)
        seconds = float(re.search(r"seconds=([\d.]+)", done.stdout).group(1))
        return np.fromfile(paths[3], np.float32).reshape(-1, shot.SIZE + 9)[:, :shot.SIZE], seconds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("cloud", type=Path)
    parser.add_argument("--pcl", required=True, help="the reference program")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repeat", type=int, default=5)
    options = parser.parse_args()
    config = Config()
    numba.set_num_threads(options.threads)
    points, point_normals, keypoints = prepared(options.cloud, config)
    radius_m = config.shot.radius_m
    print(f"{len(points)} points, {len(keypoints)} keypoints, radius {radius_m} m, {options.threads} threads")

    ours_s, pcl_s = [], []
    shot.describe(points[keypoints[:10]], shot.support(points, point_normals, radius_m), 5)   # compile
    for _ in range(options.repeat):
        begin = time.perf_counter()
        ours, _ = shot.describe(points[keypoints], shot.support(points, point_normals, radius_m), 5)
        ours_s.append(time.perf_counter() - begin)
        theirs, seconds = pcl_descriptors(
            options.pcl, points, point_normals, keypoints, radius_m, options.threads)
        pcl_s.append(seconds)
    both = np.isfinite(ours[:, 0]) & np.isfinite(theirs[:, 0])
    cosine = np.einsum("ij,ij->i", ours[both], theirs[both])
    described = [np.isfinite(d[:, 0]).mean() for d in (ours, theirs)]
    print("share described: ours {:.3f}, PCL {:.3f}".format(*described))
    print(f"cosine similarity: median {np.median(cosine):.5f}, share above 0.99 {(cosine > 0.99).mean():.3f}")
    print(f"seconds, median of {options.repeat}: ours {np.median(ours_s):.3f}, PCL {np.median(pcl_s):.3f}, "
          f"PCL / ours {np.median(pcl_s) / np.median(ours_s):.2f}")


if __name__ == "__main__":
    main()

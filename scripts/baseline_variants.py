"""How the baselines came to be set up: mean error of static points in metres, one column per folder.

    python scripts/baseline_variants.py FOLDER… [--n-scans 4]

Every row is a baseline as it is, or with one thing changed. Folders need a truth. The last two columns are
generated scenes in which the sensor moves 0.2 and 0.4 m.
"""

import argparse
import contextlib
from dataclasses import replace
from pathlib import Path
from unittest import mock

import numpy as np
from evaluate import number, table

from lidarflow import methods, metrics, pair_reports, runner, synthetic
from lidarflow.baselines import icp
from lidarflow.config import Config, EgoConfig
from lidarflow.datasets import open_dataset
from lidarflow.lidar import ego, odometry, registration
from lidarflow.types import Scan, ScanPair, Truth

KISS_ALONE = replace(Config(), ego=EgoConfig(method="kiss_icp", refine=False))
Sequence = tuple[list[Scan], list[Truth]]


def stages(*changed: icp.Stage):
    """ICP with other stages."""
    return mock.patch.object(icp, "STAGES", changed)


def of_all(**changes):
    """ICP with the same change in all stages."""
    return stages(*(stage._replace(**changes) for stage in icp.STAGES))


def finished_by(register):
    """RANSAC followed by another registration from its start value."""
    return mock.patch.object(ego, "register", register)


def with_ground():
    """ICP of all usable points."""
    return mock.patch.object(icp, "_standing", lambda scan, masks: scan.points[masks.usable])


def point_to_point(source, target, start, start_off_m):
    """The finest stage of ICP, on the clouds that point-to-plane has."""
    return registration.point_to_point(source.points, target.points, 0.25, start)


def kiss_voxel(voxel_m: float):
    """KISS-ICP with another voxel; its own is a hundredth of the longest range, 0.8 m."""
    kiss_icp = odometry._kiss_icp

    def made(limits):
        from kiss_icp.kiss_icp import KissICP

        config = kiss_icp(limits).config
        config.mapping.voxel_size = voxel_m
        return KissICP(config)

    return mock.patch.object(odometry, "_kiss_icp", made)


def variants():
    """Title, method, settings and what is changed."""
    as_it_is = contextlib.nullcontext()
    last = icp.STAGES[-1]
    default = Config()
    return [
        ("zero", "zero", default, as_it_is),
        ("icp", "icp", default, as_it_is),
        ("with ground", "icp", default, with_ground()),
        ("one stage, reach 3 m", "icp", default, stages(last._replace(reach=15.0))),
        ("last reach 0.5 m", "icp", default, stages(*icp.STAGES[:-1], last._replace(reach=2.5))),
        ("one more, reach 0.12 m", "icp", default, stages(*icp.STAGES, last._replace(reach=0.6))),
        ("target as thin as the source", "icp", default, of_all(target=1.0)),
        ("voxels of 0.5 m", "icp", default, of_all(source=2.5, target=2.5)),
        ("ransac_icp", "ransac_icp", default, as_it_is),
        ("RANSAC alone", "ransac_icp", default, finished_by(lambda source, target, start, *_: start)),
        ("then point-to-point, with ground", "ransac_icp", default, finished_by(point_to_point)),
        ("ego", "ego", default, as_it_is),
        ("KISS-ICP alone", "ego", KISS_ALONE, as_it_is),
        ("its voxels 0.5 m", "ego", KISS_ALONE, kiss_voxel(0.5)),
        ("its voxels 0.2 m", "ego", KISS_ALONE, kiss_voxel(0.2)),
    ]


def recorded(folder: Path, n_scans: int | None) -> Sequence:
    dataset = open_dataset(folder)
    frames = runner.choose_frames(dataset, 0, n_scans)
    scans = [dataset.scan(frame) for frame in frames]
    truths = [pair_reports.find_truth(dataset, frame, ScanPair(*scans[k:k + 2]))[0]
              for k, frame in enumerate(frames[:-1])]
    if None in truths:
        raise SystemExit(f"{folder}: no truth, neither flow nor poses; give a folder that has one")
    return scans, truths


def generated(make) -> Sequence:
    rng = np.random.default_rng(0)
    drive = synthetic.scan_sequence(make(rng), synthetic.hdl64e(columns=900), 2, rng)
    return [scan for scan, _ in drive], [truth for _, truth in drive[:-1]]


def static_error_m(name: str, config: Config, sequence: Sequence) -> float:
    """Mean over pairs of the mean end-point error of static points."""
    scans, truths = sequence
    estimator = methods.find(name).along(config)
    results = [estimator.step(scan) for scan in scans][1:]
    return float(np.mean([metrics.score(scan.points, result, truth).static.mean
                          for scan, result, truth in zip(scans, results, truths, strict=False)]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--n-scans", type=int)
    options = parser.parse_args()
    columns = {folder.name: recorded(folder, options.n_scans) for folder in options.folders}
    columns["room, 0.2 m"] = generated(synthetic.room)
    columns["open place, 0.4 m"] = generated(lambda rng: synthetic.one_car(8.0, rng))
    rows = []
    for title, name, config, changed in variants():
        with changed:
            rows.append([title, *(number(static_error_m(name, config, drive))
                                  for drive in columns.values())])
    print(table(["static points, mean error [m]", *columns], rows))


if __name__ == "__main__":
    main()

"""A program that uses lidarflow as a library, for the type checker and for test_library.py."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import lidarflow
from lidarflow import Config, FlowEstimator, FlowResult, LidarflowError, MovingObject, Scan, ScanPair


def of_two_arrays(source: NDArray[np.float32], target: NDArray[np.float32]) -> FlowResult:
    """Flow between two clouds that a program already has."""
    return lidarflow.estimate_flow((source, target))


def of_two_files(source: Path, target: Path) -> np.ndarray:
    """The flow that the points have by themselves."""
    pair = ScanPair(lidarflow.read_scan(source), lidarflow.read_scan(target))
    settings: Config = lidarflow.load(overrides=("solver.method=fast",))
    result = lidarflow.estimate_flow(pair, settings)
    return result.residual_flow(pair.source.points)


def along(folder: Path) -> list[float]:
    """Speeds of all moving objects of a data set, in m/s; what cannot be used is passed over."""
    dataset = lidarflow.open_dataset(folder)
    estimator = FlowEstimator(lidarflow.load(overrides=("solver.method=fast",)))
    speeds: list[float] = []
    for index in range(len(dataset)):
        try:
            scan: Scan = dataset.scan(index)
            result = estimator.step(scan)
        except LidarflowError:
            continue
        if result is not None:
            found: tuple[MovingObject, ...] = result.objects
            speeds += [float(np.linalg.norm(moving.velocity)) for moving in found]
            assert result.object_id.shape == result.std_m.shape == result.is_ground.shape
    return speeds


def first_to_last(folder: Path) -> FlowResult:
    """Flow from a data set's first scan to its last."""
    dataset = lidarflow.open_dataset(folder)
    names: list[str] = [scan.name for scan in dataset]
    assert [dataset[0].name, dataset[-1].name] == [names[0], names[-1]]
    settings = lidarflow.load(overrides=("solver.method=fast",))
    return lidarflow.estimate_flow((dataset[0], dataset[-1]), settings)

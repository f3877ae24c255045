"""A run's results as the formats take them: pairs in order, times and poses of all scans."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lidarflow import io, provenance, rgbd_io
from lidarflow.config import Config, load
from lidarflow.datasets import Dataset, tum
from lidarflow.datasets.argoverse2 import Argoverse2
from lidarflow.datasets.clouds import natural_sorted
from lidarflow.errors import DataError

_FINISH = "was the run cut short? run it again"


@dataclass(frozen=True, slots=True, eq=False)
class FinishedRun:
    """A run folder, and where its data are now if not where they were.

    times_ns           (N,) int64           time of every scan, increasing
    world_from_sensor  (N, 4, 4) float64    pose of every scan; the first is the world
    """

    folder: Path
    data: Path | None
    times_ns: np.ndarray
    world_from_sensor: np.ndarray

    @classmethod
    def read(cls, folder: Path, data: Path | None = None) -> "FinishedRun":
        """The run in `folder`; DataError where there is none, or it was cut short."""
        if not (folder / io.FLOW_FOLDER).is_dir():
            raise DataError(f"{folder}: no folder '{io.FLOW_FOLDER}'; "
                            "expected a folder that 'lidarflow run' wrote")
        poses = folder / "poses_tum.txt"
        if not poses.is_file():
            raise DataError(f"{folder}: no {poses.name}; {_FINISH}")
        times_ns, world_from_sensor = tum.read_poses(poses)
        if len(times_ns) < 2 or not (np.diff(times_ns) > 0).all():
            raise DataError(f"{poses}: expected a pose for two scans or more, in order of time; {_FINISH}")
        return cls(folder, data, times_ns, world_from_sensor)

    def pairs(self) -> Iterator[tuple[int, str, io.FlowFile]]:
        """Number, name of the source scan and flow of every pair; DataError where one is missing."""
        files = natural_sorted((self.folder / io.FLOW_FOLDER).glob("*.npz"))
        if len(files) != len(self.times_ns) - 1:
            raise DataError(f"{self.folder}: {len(files)} flow files for {len(self.times_ns) - 1} pairs; "
                            f"{_FINISH}")
        for number, file in enumerate(files):
            if rgbd_io.is_rgbd_flow(file):
                raise DataError(f"{self.folder}: is a run of RGB-D images; of those, only poses are exported")
            yield number, file.stem, io.load_flow(file)

    def dt_s(self, number: int) -> float:
        """Seconds from the source to the target of a pair."""
        return float(self.times_ns[number + 1] - self.times_ns[number]) * 1e-9

    def dataset(self) -> Dataset:
        """The data set that the run was made of; DataError where it is not at hand."""
        return provenance.opened(self.folder, provenance.read(self.folder).dataset, self.data)

    def last_scan(self, dataset: Dataset) -> np.ndarray:
        """Points (N, 3) of the last scan, metres: the only one without a flow file."""
        return dataset.scan(provenance.read(self.folder).scans[-1]).points

    def config(self) -> Config:
        """The settings that the run was made with."""
        return load(self.folder / io.CONFIG_FILE)


def scene_name(dataset: Dataset) -> str:
    """What files call a sequence: an Argoverse 2 log by its id, all others by letters, digits, - and _."""
    name = dataset.folder.absolute().name if isinstance(dataset, Argoverse2) else dataset.name
    return re.sub(r"[^A-Za-z0-9_-]+", "_", name)

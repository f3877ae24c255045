"""A run's results as the formats take them: pairs in order, times and poses of their scans."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lidarflow import flow_files, io, pose, provenance, rgbd_io
from lidarflow.config import Config, load
from lidarflow.datasets import Dataset, tum
from lidarflow.datasets.argoverse2 import Argoverse2
from lidarflow.datasets.clouds import natural_sorted
from lidarflow.errors import DataError
from lidarflow.provenance import RunSource
from lidarflow.trajectory import Trajectory

_FINISH = "was the run cut short? run it again"


@dataclass(frozen=True, slots=True, eq=False)
class FinishedRun:
    """A run folder, and where its data are now if not where they were.

    Its scans are those of its pairs, numbered on over the gaps where others were left out.

    source             RunSource            what it was made of
    scans              N of int             index of every scan in the data set
    times_ns           (N,) int64           time of every scan, increasing
    world_from_sensor  (N, 4, 4) float64    pose of every scan; the first is the world
    """

    folder: Path
    data: Path | None
    source: RunSource
    scans: tuple[int, ...]
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
        source = provenance.read_any(folder)
        scans = tuple(sorted({index for pair in source.pairs for index in pair}))
        if len(scans) != len(times_ns):
            raise DataError(f"{poses}: {len(times_ns)} poses for {len(scans)} scans; {_FINISH}")
        return cls(folder, data, source, scans, times_ns, world_from_sensor)

    def sources(self) -> list[int]:
        """Number of the source scan of every pair, in order; its target is the next scan."""
        number_of = {index: number for number, index in enumerate(self.scans)}
        return [number_of[index] for index, _ in self.source.pairs]

    def pairs(self) -> Iterator[tuple[int, str, flow_files.FlowFile]]:
        """Number and name of the source scan, and flow, of every pair; DataError where one is missing."""
        sources = self.sources()
        files = natural_sorted((self.folder / io.FLOW_FOLDER).glob("*.npz"))
        if len(files) != len(sources):
            raise DataError(f"{self.folder}: {len(files)} flow files for {len(sources)} pairs; {_FINISH}")
        for number, file in zip(sources, files, strict=True):
            if rgbd_io.is_rgbd_flow(file):
                raise DataError(f"{self.folder}: is a run of RGB-D images; of those, only poses are exported")
            yield number, file.stem, flow_files.load_flow(file)

    def dt_s(self, number: int) -> float:
        """Seconds from the source scan of a pair to its target."""
        return float(self.times_ns[number + 1] - self.times_ns[number]) * 1e-9

    def dataset(self) -> Dataset:
        """The data set that the run was made of; DataError where it is not at hand."""
        return provenance.opened(self.folder, provenance.read(self.folder).dataset, self.data)

    def without_flow(self, dataset: Dataset) -> Iterator[tuple[int, np.ndarray]]:
        """Number and points (N, 3), metres, of scans that are no source: the last, and those before a gap."""
        for number in sorted(set(range(len(self.scans))).difference(self.sources())):
            yield number, dataset.scan(self.scans[number]).points

    def every_pose(self) -> np.ndarray:
        """Poses (N, 4, 4) of all scans gone through, with those that were left out, as in poses_kitti.txt."""
        row_of = {index: row for row, index in enumerate(self.source.scans)}
        way = Trajectory(list(row_of.values()))
        for number in self.sources():
            world_from_source, world_from_target = self.world_from_sensor[number:number + 2]
            begin_ns, end_ns = self.times_ns[number:number + 2].tolist()
            way.go(row_of[self.scans[number]], (begin_ns, end_ns),
                   pose.inverse(world_from_target) @ world_from_source)
        return way.poses()

    def config(self) -> Config:
        """The settings that the run was made with."""
        return load(self.folder / io.CONFIG_FILE)


def scene_name(dataset: Dataset) -> str:
    """What files call a sequence: an Argoverse 2 log by its id, all others by letters, digits, - and _."""
    name = dataset.folder.absolute().name if isinstance(dataset, Argoverse2) else dataset.name
    return re.sub(r"[^A-Za-z0-9_-]+", "_", name)

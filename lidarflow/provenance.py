"""What a run was made of: kept in its folder, so that its data set can be opened again."""

import itertools
import json
from dataclasses import asdict, dataclass
from pathlib import Path

from lidarflow import io
from lidarflow.datasets import Dataset, Source, open_dataset
from lidarflow.datasets.rgbd_folders import RgbdSource
from lidarflow.errors import DataError
from lidarflow.rgbd_types import Camera


@dataclass(frozen=True, slots=True)
class RunSource:
    """A data set, None where `open_dataset` did not open it, and the indices of the scans gone through.

    skipped  those among them that could not be used
    """

    dataset: Source | RgbdSource | None
    scans: tuple[int, ...]
    skipped: tuple[int, ...] = ()

    @property
    def pairs(self) -> list[tuple[int, int]]:
        """Indices of source and target of every pair that there is a flow of."""
        left_out = set(self.skipped)
        return [pair for pair in itertools.pairwise(self.scans) if left_out.isdisjoint(pair)]


def write(run_dir: Path, source: RunSource) -> None:
    """Write source.json into a run folder."""
    described = {}
    match source.dataset:
        case Source() as opened:
            described = {"data": str(opened.folder), "loader": opened.loader, "sequence": opened.sequence,
                         "kitti_correction": opened.kitti_correction}
        case RgbdSource() as opened:
            described = {"data": str(opened.folder), "camera": asdict(opened.camera),
                         "depth_scale": opened.depth_scale}
    io.write_json(run_dir / io.SOURCE_FILE, {
        **described, "scans": source.scans, **({"skipped": source.skipped} if source.skipped else {})})


def read(run_dir: Path) -> RunSource:
    """What source.json in a LiDAR run's folder says; DataError where there is none, or it is damaged."""
    source = read_any(run_dir)
    if isinstance(source.dataset, RgbdSource):
        raise DataError(f"{run_dir}: is a run of RGB-D images; expected one of LiDAR scans")
    return source


def read_any(run_dir: Path) -> RunSource:
    """As `read`, but of RGB-D images too."""
    file = run_dir / io.SOURCE_FILE
    try:
        values = json.loads(file.read_text(encoding="utf-8"))
        scans = tuple(int(index) for index in values["scans"])
        if len(scans) < 2 or min(scans) < 0:
            raise ValueError("scans must be two indices or more")
        skipped = tuple(int(index) for index in values.get("skipped", ()))
        if "data" not in values:
            return RunSource(None, scans, skipped)
        if "camera" in values:
            camera, folder = Camera(**values["camera"]), Path(values["data"])
            return RunSource(RgbdSource(folder, camera, float(values["depth_scale"])), scans, skipped)
        texts = values["data"], values["loader"], values["kitti_correction"]
        if not all(isinstance(text, str) for text in texts):
            raise ValueError("data, loader and kitti_correction must be texts")
        if not isinstance(values["sequence"], str | None):
            raise ValueError("sequence must be a text or null")
        return RunSource(Source(Path(values["data"]), values["loader"], values["sequence"],
                                values["kitti_correction"]), scans, skipped)
    except FileNotFoundError:
        raise DataError(f"{run_dir}: no {io.SOURCE_FILE}, which says what a run was made of; "
                        "expected a folder that 'lidarflow run' wrote") from None
    except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        raise DataError(f"{file}: damaged ({type(error).__name__}: {error}); run again") from None


def opened(run_dir: Path, source: Source | None, data: Path | None = None, instead: str = "") -> Dataset:
    """The data set of a run, from `source` or from `data`, where the data are now.

    `instead` is what else a message may advise, e.g. ", or --truth". Raises DataError where the data are not
    at hand.
    """
    if data is not None:
        kept = source if source is not None else Source(data, None, None, "auto")
        return open_dataset(data, kept.loader, kept.sequence, kept.kitti_correction)
    if source is None:
        raise DataError(f"{run_dir}: was not made from a data folder; give --data{instead}")
    if not source.folder.exists():
        raise DataError(f"{source.folder}: no such folder any more, and {run_dir} was made from it; "
                        f"give --data with its new place{instead}")
    return open_dataset(source.folder, source.loader, source.sequence, source.kitti_correction)

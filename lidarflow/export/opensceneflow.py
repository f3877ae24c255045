"""OpenSceneFlow's layout (Zhang et al., KTH): <scene>.h5 with a group per time, and the lists of groups.

A group holds `lidar` (N, 3) float32, `ground_mask` (N,) bool and `pose` (4, 4) float32 world_from_sensor; all
but the last, at the end or before a gap, also `flow` (N, 3) float32 total, `flow_is_valid` (N,) bool,
`flow_category_indices` (N,) uint8, `flow_instance_id` (N,) int16 and `ego_motion` (4, 4) float32
target_from_source. index_total.pkl and index_flow.pkl list [scene, time] of all groups, and of those with a
flow, of every .h5 file in the folder.
"""

import pickle
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from lidarflow.datasets.clouds import natural_sorted, one_line
from lidarflow.errors import DataError, InstallError
from lidarflow.export.finished_run import FinishedRun, scene_name
from lidarflow.flow_files import FlowFile
from lidarflow.io import written_aside
from lidarflow.lidar import features
from lidarflow.types import Scan

_NOT_CLASSIFIED = 0     # what OpenSceneFlow calls NONE: an estimate knows no classes


def write(run: FinishedRun, out: Path) -> Iterator[Path]:
    """One .h5 file for the run, rows without a finite point left out, and the lists of the folder."""
    try:
        import h5py
    except ImportError:
        raise InstallError(f"{out}: .h5 needs the package h5py; pip install h5py") from None
    dataset = run.dataset()
    file = out / f"{scene_name(dataset)}.h5"
    with written_aside(file) as aside, h5py.File(aside, "w") as archive:
        for number, _, found in run.pairs():
            _write_group(archive, run, number, _pair_arrays(found))
        for number, points in run.without_flow(dataset):
            _write_group(archive, run, number, _scan_arrays(points, run))
    yield file
    yield from _write_lists(out, h5py)


def _write_group(archive, run: FinishedRun, number: int, arrays: dict[str, np.ndarray]) -> None:
    group = archive.create_group(str(run.times_ns[number]))
    group["pose"] = run.world_from_sensor[number].astype(np.float32)
    for name, array in arrays.items():
        group[name] = array


def _pair_arrays(found: FlowFile) -> dict[str, np.ndarray]:
    known = np.isfinite(found.points).all(axis=1) & np.isfinite(found.flow).all(axis=1)
    return {
        "lidar": found.points[known],
        "ground_mask": found.is_ground[known],
        "flow": found.flow[known],
        "flow_is_valid": found.valid[known],
        "flow_category_indices": np.full(known.sum(), _NOT_CLASSIFIED, np.uint8),
        # 0 is the background there, -1 here.
        "flow_instance_id": np.clip(found.object_id[known] + 1, 0, np.iinfo(np.int16).max).astype(np.int16),
        "ego_motion": found.ego_motion.astype(np.float32),
    }


def _scan_arrays(points: np.ndarray, run: FinishedRun) -> dict[str, np.ndarray]:
    known = np.isfinite(points).all(axis=1)
    ground = features.masks(Scan(points), run.config()).ground
    return {"lidar": points[known].astype(np.float32), "ground_mask": ground[known]}


def _write_lists(out: Path, h5py) -> Iterator[Path]:
    """Write the lists of all scenes in `out`: earlier exports into the same folder stay listed."""
    total, with_flow = [], []
    for file in natural_sorted(out.glob("*.h5")):
        try:
            with h5py.File(file, "r") as archive:
                times = sorted(archive, key=int)
                total += [[file.stem, time] for time in times]
                with_flow += [[file.stem, time] for time in times if "flow" in archive[time]]
        except (OSError, ValueError) as error:
            raise DataError(f"{file}: no scene of OpenSceneFlow ({one_line(error)}); move it away") from None
    for name, listed in (("index_total.pkl", total), ("index_flow.pkl", with_flow)):
        with written_aside(out / name) as aside:
            aside.write_bytes(pickle.dumps(listed, protocol=4))
        yield out / name

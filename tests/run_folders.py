"""Run folders with a known answer, as `lidarflow run` leaves them."""

import numpy as np

from lidarflow import flow_files, io, pose, provenance
from lidarflow.config import load
from lidarflow.types import FlowResult, SolveStats

CONFIG = load(overrides=("preparation.kitti_correction=off", "crispness.sigma_m=0.3"))
STATS = SolveStats("none", 0, 0, 0, 0, 0, 0, 0, 0.0, 0.0, 0.0, 0.0, 0, {})
OFF_M = 0.02     # every static point is off by this much, along z


def write_run(run_dir, dataset, scans):
    """A run over some scans of a data set: settings, source, flow files and poses."""
    (run_dir / "flow").mkdir(parents=True)
    io.write_toml(run_dir / "config.toml", CONFIG)
    provenance.write(run_dir, provenance.RunSource(dataset.source, scans))
    world_from_sensor = [np.eye(4)]
    for index in scans[:-1]:
        scan = dataset.scan(index)
        result = answer(scan, dataset.truth(index))
        flow_files.save_flow(run_dir / "flow" / f"{scan.name}.npz", scan.points, result, CONFIG)
        world_from_sensor.append(world_from_sensor[-1] @ pose.inverse(result.ego_motion))
    times_ns = [dataset.scan(index).time_ns for index in scans]
    io.write_poses_tum(run_dir / "poses_tum.txt", np.stack(world_from_sensor), times_ns)
    return run_dir


def flows(run_dir):
    """What the flow files of a run hold, in order."""
    return [flow_files.load_flow(file) for file in sorted((run_dir / "flow").iterdir())]


def answer(scan, truth):
    """The true flow, static points off by OFF_M; no motion and no movers where there is no truth."""
    n = len(scan)
    moves, flow, ego_motion = np.zeros(n, bool), np.zeros((n, 3)), np.eye(4)
    if truth is not None:
        moves, flow, ego_motion = truth.is_dynamic, truth.flow.copy(), truth.ego_motion
    flow[~moves, 2] += OFF_M
    everywhere = np.ones(n, bool)
    return FlowResult(flow, pose.from_translation(flow), everywhere, everywhere, moves, ego_motion, STATS,
                      is_ground=scan.points[:, 2] < -1.7,
                      object_id=None if truth is None else ids_of(truth))


def ids_of(truth):
    """What moves, by the truth's number of it."""
    return np.where(truth.is_dynamic, truth.object_id, -1).astype(np.int32)

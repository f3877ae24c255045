"""Runs that left scans out: what others read of them keeps apart what lies before and behind a gap."""

import json
import pickle
import shutil
import zipfile
from dataclasses import replace
from io import BytesIO

import numpy as np
import pytest
from cloud_files import write_bin

from lidarflow import export, flow_files, pose, provenance, synthetic
from lidarflow.config import Config, EgoConfig
from lidarflow.datasets import open_dataset
from lidarflow.datasets.argoverse2 import read_columns
from lidarflow.runner import Going, Viewing, process
from lidarflow.trajectory import Trajectory

pytestmark = pytest.mark.usefixtures("in_tmp_path")

SCANS, LEFT_OUT = 7, (2, 6)
NAMES, TARGETS = ("000000", "000003", "000004"), (1, 4, 5)
NS = 100_000_000     # from scan to scan


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A drive in KITTI's layout, one scan cut short and the last one nearly empty, and a run over it."""
    place, rng = tmp_path_factory.mktemp("gaps"), np.random.default_rng(0)
    drive = synthetic.scan_sequence(synthetic.street(rng), synthetic.hdl64e(columns=300), SCANS, rng)
    synthetic.write_kitti(place / "data", drive)
    cut, few = (place / "data" / "sequences" / "00" / "velodyne" / f"{index:06d}.bin" for index in LEFT_OUT)
    cut.write_bytes(cut.read_bytes()[:-7])
    write_bin(few, drive[6][0].points[:2])
    dataset = open_dataset(place / "data", kitti_correction="off")
    config = replace(Config(), ego=EgoConfig(method="registration"))
    process(dataset, list(range(SCANS)), config, place / "run", Viewing(record=False), method="ego",
            going=Going(skip_bad=True))
    return place, [scan for scan, _ in drive]


@pytest.fixture
def run(made, tmp_path):
    """A folder of the run for one test, and the scans of the drive."""
    return shutil.copytree(made[0] / "run", tmp_path / "run"), made[1]


def test_the_sensor_goes_on_over_a_gap_for_as_long_as_its_times_say():
    def way_of(times_ns, ego_motion, frames=5, pairs=(0, 3)):
        way = Trajectory(list(range(frames)))
        for index in pairs:
            way.go(index, (times_ns[index], times_ns[index + 1]), ego_motion)
        return way

    forward = pose.from_translation([-1.0, 0.0, 0.0])     # 10 m/s
    slow = way_of([0, NS, 0, 11 * NS, 12 * NS], forward, frames=7)
    np.testing.assert_allclose(slow.poses()[:, 0, 3], [0, 1, 6, 11, 12, 13, 14], atol=1e-9)
    np.testing.assert_allclose(slow.timed()[1][:, 0, 3], [0, 1, 11, 12], atol=1e-9)
    turning = pose.exp(np.array([0.01, 0.02, 0.3, 1.0, 0.2, 0.1]))
    steps = pose.trajectory(np.tile(turning, (4, 1, 1)))
    for times_ns in ([0, NS, 0, 3 * NS, 4 * NS], [0, 0, 0, 0, 0]):    # as long as always, and not known
        np.testing.assert_array_equal(way_of(times_ns, turning).poses(), steps)
    later = way_of([0, 0, 2 * NS, 3 * NS], forward, frames=4, pairs=(2,))
    np.testing.assert_allclose(later.poses()[:, 0, 3], [0, 0, 0, 1], atol=1e-9)


def motions(run_dir):
    """The ego-motions of the run's pairs."""
    return [flow_files.load_flow(run_dir / "flow" / f"{name}.npz").ego_motion for name in NAMES]


def test_every_pair_has_its_cloud(run, tmp_path):
    files = list(export.export(run[0], "ply", tmp_path / "ply"))
    assert [file.stem for file in files] == list(NAMES)


def test_argoverse_files_are_called_by_the_times_of_their_scans(run, tmp_path):
    pytest.importorskip("pyarrow")
    files = list(export.export(run[0], "av2-v1", tmp_path / "av2"))
    assert [file.stem for file in files] == [str(index * NS) for index in (0, 3, 4)]
    for file, name in zip(files, NAMES, strict=True):
        found = flow_files.load_flow(run[0] / "flow" / f"{name}.npz")
        np.testing.assert_array_equal(
            read_columns(file, ("flow_tx_m",))["flow_tx_m"], found.flow[:, 0].astype(np.float16))


def test_a_challenge_that_counts_a_scan_before_a_gap_is_not_answered(run, tmp_path):
    pyarrow, feather = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.feather")
    mask = BytesIO()
    feather.write_feather(pyarrow.table({"mask": [True]}), mask)
    with zipfile.ZipFile(tmp_path / "masks.zip", "w") as archive:
        archive.writestr(f"kitti_00/{NS}.feather", mask.getvalue())
    with pytest.raises(export.DataError, match="no flow of 1 of the 1 sweeps"):
        list(export.export(run[0], "av2-v1", tmp_path / "av2", masks=tmp_path / "masks.zip"))


def test_scenes_hold_every_scan_under_its_own_time(run, tmp_path):
    h5py = pytest.importorskip("h5py")
    list(export.export(run[0], "opensceneflow", tmp_path / "h5"))
    total, with_flow = (
        [int(time) // NS for _, time in pickle.loads((tmp_path / "h5" / f"index_{name}.pkl").read_bytes())]
        for name in ("total", "flow"))
    assert total == [0, 1, 3, 4, 5] and with_flow == [0, 3, 4]
    with h5py.File(tmp_path / "h5" / "kitti_00.h5", "r") as scene:
        groups = {index: scene[str(index * NS)] for index in total}
        for index, group in groups.items():
            np.testing.assert_array_equal(group["lidar"][:], run[1][index].points.astype(np.float32))
        for source, target in zip(with_flow, TARGETS, strict=True):
            relative = np.linalg.inv(groups[target]["pose"][:]) @ groups[source]["pose"][:]
            np.testing.assert_allclose(relative, groups[source]["ego_motion"][:], atol=1e-5)


def test_the_number_of_a_line_of_poses_is_that_of_the_scan(run, tmp_path):
    kitti, = export.export(run[0], "kitti", tmp_path / "kitti.txt")
    expected = np.loadtxt(run[0] / "poses_kitti.txt")
    assert len(expected) == SCANS
    np.testing.assert_allclose(np.loadtxt(kitti), expected, atol=1e-12)
    camera, = export.export(run[0], "kitti-camera", tmp_path / "camera.txt")
    camera_from_lidar = open_dataset(provenance.read(run[0]).dataset.folder).camera_from_lidar()
    world_from_camera = np.tile(np.eye(4), (SCANS, 1, 1))
    world_from_camera[:, :3] = np.loadtxt(camera).reshape(-1, 3, 4)
    world_from_sensor = pose.inverse(camera_from_lidar) @ world_from_camera @ camera_from_lidar
    np.testing.assert_allclose(world_from_sensor[:, :3].reshape(-1, 12), expected, atol=1e-9)
    relative = pose.inverse(world_from_sensor[list(TARGETS)]) @ world_from_sensor[[0, 3, 4]]
    np.testing.assert_allclose(relative, motions(run[0]), atol=1e-9)
    tum, = export.export(run[0], "tum", tmp_path / "tum.txt")
    np.testing.assert_allclose(np.loadtxt(tum)[:, 0] * 10, [0, 1, 3, 4, 5])


def test_a_target_without_flow_is_not_taken_from_behind_the_gap(lidarflow, run):
    made_of = provenance.read(run[0])
    provenance.write(run[0], replace(made_of, dataset=None))
    truth = made_of.dataset.folder / "sequences" / "00" / "truth"
    before = [pair["alignment"] for pair in json.loads((run[0] / "metrics.json").read_text())["pairs"]]
    lidarflow.ok("eval", "run", "--truth", truth)
    after = [pair["alignment"] for pair in json.loads((run[0] / "metrics.json").read_text())["pairs"]]
    assert (after[0], after[2]) == (before[0], before[2]), "what the run recorded"
    (run[0] / "metrics.json").unlink()
    lidarflow.ok("eval", "run", "--truth", truth)
    pairs = json.loads((run[0] / "metrics.json").read_text())["pairs"]
    assert [pair["frame"] for pair in pairs] == list(NAMES)
    assert [pair["alignment"]["after"] is not None for pair in pairs] == [False, True, False]


def test_poses_that_are_not_those_of_the_run(lidarflow, run):
    lines = (run[0] / "poses_tum.txt").read_text().splitlines(keepends=True)
    (run[0] / "poses_tum.txt").write_text("".join(lines[:-1]))
    assert "4 poses for 5 scans; was the run cut short?" in lidarflow.complaint(
        "export", "run", "--format", "kitti")

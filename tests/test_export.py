"""`lidarflow export`: what other programs read is what the run holds; one clear line for bad input."""

import pickle
import shutil
import sys

import numpy as np
import pytest
from argoverse_log import TIMES, write_log
from command_line import drive, rests
from run_folders import STATS, flows, write_run

from lidarflow import colour, config, export, flow_files, pose, provenance, settings, synthetic
from lidarflow.datasets import open_dataset, read_points
from lidarflow.datasets.argoverse2 import read_columns
from lidarflow.types import FlowResult

pytestmark = pytest.mark.usefixtures("in_tmp_path")

LOG = "7fab"
FLOW_COLUMNS = ["flow_tx_m", "flow_ty_m", "flow_tz_m"]
HALF_PRECISION = 2.0 ** -11     # relative, of float16


@pytest.fixture
def run(tmp_path):
    """A run over a generated drive in KITTI's layout; the first point of the second scan is not known."""
    synthetic.write_kitti(tmp_path / "data", drive())
    run_dir = write_run(tmp_path / "run", open_dataset(tmp_path / "data", kitti_correction="off"), (0, 1, 2))
    make_unknown(run_dir / "flow" / "000001.npz")
    return run_dir


@pytest.fixture
def log_run(tmp_path):
    """A run over a generated log of Argoverse 2."""
    write_log(tmp_path / "av2")
    return write_run(tmp_path / "log run", open_dataset(tmp_path / "av2"), (0, 1, 2))


def make_unknown(file):
    found = flow_files.load_flow(file)
    found.points[0] = found.flow[0] = np.nan
    used = settings.updated(config.Config(), found.config, str(file))
    flow_files.save_flow(file, found.points, found.result(), used)


def table(file):
    import pyarrow
    from pyarrow import feather
    names = feather.read_table(file).column_names
    assert feather.read_table(file).schema.metadata is None and pyarrow.__version__
    return names, read_columns(file, names)


# Argoverse 2.

@pytest.mark.parametrize("version, before, after", [
    ("av2-v1", [], ["is_dynamic"]), ("av2-v2", ["is_valid"], []), ("av2-v3", [], [])])
def test_argoverse_files_hold_the_flow_of_the_run(lidarflow, log_run, tmp_path, version, before, after):
    out = lidarflow.ok("export", log_run, "--format", version, "--out", "sub")
    assert f"format     {version}" in out and f"sub/{LOG}/{TIMES[0]}.feather and 1 more files" in out
    files = sorted(tmp_path.glob("sub/**/*.*"))
    assert files == [tmp_path / "sub" / LOG / f"{time_ns}.feather" for time_ns in TIMES[:2]]
    for file, found in zip(files, flows(log_run), strict=True):
        names, columns = table(file)
        assert names == [*before, *FLOW_COLUMNS, *after]
        assert {columns[name].dtype for name in FLOW_COLUMNS} == {np.dtype(np.float16)}
        expected = found.flow.astype(float)
        if version != "av2-v1":
            expected = expected - (pose.apply(found.ego_motion, found.points.astype(float)) - found.points)
        stored = np.stack([columns[name] for name in FLOW_COLUMNS], axis=1).astype(float)
        np.testing.assert_allclose(stored, expected, rtol=HALF_PRECISION, atol=1e-6)
        assert np.abs(stored).max() > 0.3, "something moves"
        if after:
            assert columns["is_dynamic"].dtype == bool
            np.testing.assert_array_equal(columns["is_dynamic"], found.is_dynamic)
        if before:
            assert columns["is_valid"].dtype == bool and columns["is_valid"].all()


def test_points_that_are_not_known_are_not_valid(run, tmp_path):
    second = list(export.export(run, "av2-v2", tmp_path / "out"))[1]
    assert second == tmp_path / "out" / "kitti_00" / "100000000.feather"
    names, columns = table(second)
    assert not columns["is_valid"][0] and columns["is_valid"][1:].all()
    assert all(np.isnan(columns[name][0]) for name in names[1:])


# OpenSceneFlow.

def test_a_scene_of_opensceneflow(lidarflow, run, tmp_path):
    h5py = pytest.importorskip("h5py")
    lidarflow.ok("export", "run", "--format", "opensceneflow", "--out", "h5")
    assert sorted(file.name for file in (tmp_path / "h5").iterdir()) == [
        "index_flow.pkl", "index_total.pkl", "kitti_00.h5"]
    index = pickle.loads((tmp_path / "h5" / "index_total.pkl").read_bytes())
    assert index == [["kitti_00", "0"], ["kitti_00", "100000000"], ["kitti_00", "200000000"]]
    assert pickle.loads((tmp_path / "h5" / "index_flow.pkl").read_bytes()) == index[:2]
    with h5py.File(tmp_path / "h5" / "kitti_00.h5", "r") as scene:
        assert sorted(scene) == sorted(time for _, time in index)
        for number, (found, (_, time), (_, after)) in enumerate(
                zip(flows(run), index[:-1], index[1:], strict=True)):
            group = {name: scene[time][name][:] for name in scene[time]}
            known = slice(number, None)     # of the second scan, the first point is not known
            for name, expected in (
                    ("lidar", found.points), ("flow", found.flow), ("flow_is_valid", found.valid),
                    ("ground_mask", found.is_ground), ("flow_instance_id", found.object_id + 1)):
                np.testing.assert_array_equal(group[name], expected[known], name)
            np.testing.assert_allclose(group["ego_motion"], found.ego_motion, atol=1e-6)
            relative = np.linalg.inv(scene[after]["pose"][:]) @ group["pose"]
            np.testing.assert_allclose(relative, found.ego_motion, atol=1e-5)
            assert found.is_dynamic.any() and (group["flow_instance_id"] > 0).sum() == found.is_dynamic.sum()
            assert {name: array.dtype.str for name, array in group.items()} == {
                "lidar": "<f4", "flow": "<f4", "pose": "<f4", "ego_motion": "<f4", "ground_mask": "|b1",
                "flow_is_valid": "|b1", "flow_category_indices": "|u1", "flow_instance_id": "<i2"}
        last = scene["200000000"]
        assert sorted(last) == ["ground_mask", "lidar", "pose"]
        np.testing.assert_array_equal(last["lidar"][:], drive()[2][0].points.astype(np.float32))
        height_m = last["lidar"][:][last["ground_mask"][:], 2]
        assert len(height_m) > 500 and np.quantile(np.abs(height_m + 1.73), 0.9) < 0.3, "the road's height"


def test_scenes_of_several_runs_are_listed_together(run, log_run, tmp_path):
    pytest.importorskip("h5py")
    for run_dir in (run, log_run):
        files = list(export.export(run_dir, "opensceneflow", tmp_path / "h5"))
        assert [file.name for file in files[1:]] == ["index_total.pkl", "index_flow.pkl"]
    index = pickle.loads((tmp_path / "h5" / "index_total.pkl").read_bytes())
    assert [scene for scene, _ in index] == [LOG] * 3 + ["kitti_00"] * 3
    (tmp_path / "h5" / "other.h5").write_text("text")
    with pytest.raises(export.DataError, match=r"other\.h5: no scene of OpenSceneFlow"):
        list(export.export(run, "opensceneflow", tmp_path / "h5"))


def test_a_missing_package_is_named(lidarflow, run, monkeypatch):
    monkeypatch.setitem(sys.modules, "h5py", None)
    assert ".h5 needs the package h5py; pip install h5py" in lidarflow.complaint(
        "export", "run", "--format", "opensceneflow")
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    assert "pip install pyarrow" in lidarflow.complaint("export", "run", "--format", "av2-v3")


# Clouds.

def test_clouds_have_the_colours_of_the_viewer(lidarflow, run, tmp_path):
    lidarflow.ok("export", "run", "--format", "ply")
    files = sorted((tmp_path / "run-ply").iterdir())
    assert [file.name for file in files] == ["000000.ply", "000001.ply"]
    first, second = flows(run)
    np.testing.assert_array_equal(read_points(files[0]), first.points.astype(float))
    np.testing.assert_array_equal(read_points(files[1]), second.points[1:].astype(float))
    colours, flow, numbers = vertices(files[0])
    np.testing.assert_array_equal(flow, first.flow)
    np.testing.assert_array_equal(numbers, first.object_id)
    is_grey = (colours == colours[:, :1]).all(axis=1)
    np.testing.assert_array_equal(~is_grey, first.is_dynamic)
    np.testing.assert_array_equal(
        colours[is_grey], colour.static_shade(first.points[is_grey].astype(float)))


def test_a_cloud_is_read_by_open3d(run, tmp_path):
    from lidarflow.open3d_import import open3d
    file = next(iter(export.export(run, "ply", tmp_path / "clouds")))
    cloud = open3d().io.read_point_cloud(str(file))
    colours, _, _ = vertices(file)
    np.testing.assert_allclose(np.asarray(cloud.points), flows(run)[0].points)
    np.testing.assert_allclose(np.asarray(cloud.colors) * 255, colours, atol=1e-3)


def vertices(file):
    """Colours, flow and object numbers of a cloud, read by the words of its header."""
    header, _, body = file.read_bytes().partition(b"end_header\n")
    kinds = {"float": "<f4", "uchar": "u1", "int": "<i4"}
    fields = [line.split()[1:] for line in header.decode().splitlines() if line.startswith("property")]
    rows = np.frombuffer(body, [(name, kinds[kind]) for kind, name in fields])
    return (np.stack([rows[name] for name in ("red", "green", "blue")], axis=1),
            np.stack([rows[name] for name in ("flow_x", "flow_y", "flow_z")], axis=1), rows["object"])


# Poses.

def test_poses_of_the_sensor(lidarflow, log_run, tmp_path):
    steps = [pose.inverse(found.ego_motion) for found in flows(log_run)]
    world_from_sensor = np.stack([np.eye(4), steps[0], steps[0] @ steps[1]])
    assert "written    log run-tum.txt" in lidarflow.ok("export", "log run", "--format", "tum")
    lines = [line.split() for line in (tmp_path / "log run-tum.txt").read_text().splitlines()]
    assert [words[0] for words in lines] == [f"315966265.{time_ns % 10**9:09d}" for time_ns in TIMES]
    rows = np.array([words[1:] for words in lines], float)
    np.testing.assert_allclose(pose.from_translation_quaternion(rows), world_from_sensor, atol=1e-9)
    lidarflow.ok("export", "log run", "--format", "kitti", "--out", "k.txt")
    np.testing.assert_allclose(
        np.loadtxt(tmp_path / "k.txt").reshape(3, 3, 4), world_from_sensor[:, :3], atol=1e-9)


def test_poses_of_the_camera_are_the_benchmarks(run, tmp_path):
    file, = export.export(run, "kitti-camera", tmp_path / "camera.txt")
    given = np.loadtxt(tmp_path / "data" / "poses" / "00.txt")
    np.testing.assert_allclose(np.loadtxt(file), given, atol=1e-5)


def test_poses_of_the_camera_need_a_calibration(lidarflow, log_run):
    said = lidarflow.complaint("export", "log run", "--format", "kitti-camera")
    assert "log run: its data have no calibration of a camera" in said


# All formats.

@pytest.mark.parametrize("name", export.FORMATS)
def test_the_same_run_gives_the_same_bytes(run, tmp_path, name):
    if name == "opensceneflow":
        pytest.importorskip("h5py")
    a, b = ([file.read_bytes() for file in export.export(run, name, tmp_path / place)]
            for place in ("a.txt", "b.txt"))
    assert a == b and a
    assert not rests(tmp_path)


def test_the_help_names_every_format(lidarflow):
    said = " ".join(lidarflow.ok("export", "--help").split())
    assert f"One of {', '.join(export.FORMATS)}." in said.replace(" │ │ ", " ")
    assert set(export.POSE_FILES) < export.FORMATS.keys()


@pytest.mark.parametrize("name, said", [
    ("av2", "unknown format 'av2' - did you mean 'av2-v"),
    ("openscene", "unknown format 'openscene' - did you mean 'opensceneflow'?"),
    ("xyz", "unknown format 'xyz'; known are av2-v1, av2-v2")])
def test_an_unknown_format(lidarflow, run, name, said):
    assert said in lidarflow.complaint("export", "run", "--format", name)


def test_what_is_no_finished_run(lidarflow, run, tmp_path):
    assert "empty: no folder 'flow'; expected a folder that 'lidarflow run' wrote" in lidarflow.complaint(
        "export", "empty", "--format", "ply")
    assert "out.txt: is a file; expected a folder" in complaint_of_file(lidarflow, tmp_path)
    assert "--out run: is the run itself" in lidarflow.complaint(
        "export", "run", "--format", "ply", "--out", "run")
    assert "--out run: is the run itself" in lidarflow.complaint(
        "export", "run", "--format", "kitti", "--out", "run")
    (tmp_path / "poses.csv").touch()
    assert "poses.csv: is a file; expected a folder, or a file name ending in .txt" in lidarflow.complaint(
        "export", "run", "--format", "tum", "--out", "poses.csv")
    (run / "flow" / "000000.npz").unlink()
    assert "1 flow files for 2 pairs; was the run cut short?" in lidarflow.complaint(
        "export", "run", "--format", "ply")
    (run / "poses_tum.txt").unlink()
    assert "run: no poses_tum.txt; was the run cut short?" in lidarflow.complaint(
        "export", "run", "--format", "tum")
    assert not (tmp_path / "run-ply").exists() and not rests(tmp_path)


@pytest.mark.parametrize("name, file", [("kitti", "poses_kitti.txt"), ("tum", "poses_tum.txt")])
def test_poses_go_into_a_folder_or_into_a_file(lidarflow, run, tmp_path, name, file):
    (tmp_path / "there").mkdir()
    (tmp_path / "dotted.txt").mkdir()
    lidarflow.ok("export", "run", "--format", name)
    expected = (tmp_path / f"run-{name}.txt").read_bytes()
    for out, place in (("there", f"there/{file}"), ("new/deep", f"new/deep/{file}"),
                       ("dotted.txt", f"dotted.txt/{file}"), ("mine.txt", "mine.txt")):
        assert f"written    {place}" in lidarflow.ok("export", "run", "--format", name, "--out", out)
        assert (tmp_path / place).read_bytes() == expected != b""


def complaint_of_file(lidarflow, folder):
    (folder / "out.txt").touch()
    return lidarflow.complaint("export", "run", "--format", "ply", "--out", "out.txt")


def test_damaged_flow_files_and_poses(lidarflow, run, tmp_path):
    lidarflow.ok("export", "run", "--format", "ply", "--out", "earlier")
    before = (tmp_path / "earlier" / "000000.ply").read_bytes()
    make_unknown(run / "flow" / "000000.npz")
    (run / "flow" / "000001.npz").write_bytes(b"PK")
    for name in ("opensceneflow", "ply", "av2-v2"):
        assert "not an .npz archive" in lidarflow.complaint("export", "run", "--format", name)
        assert not (tmp_path / f"run-{name}").exists(), "no half is kept, and no empty folder"
    assert "not an .npz archive" in lidarflow.complaint(
        "export", "run", "--format", "ply", "--out", "earlier")
    assert (tmp_path / "earlier" / "000000.ply").read_bytes() == before and not rests(tmp_path)
    (run / "poses_tum.txt").write_text("-1 0 0 0 0 0 0 1\n")
    assert "expected seconds, not negative" in lidarflow.complaint("export", "run", "--format", "tum")
    (run / "poses_tum.txt").write_text("0 0 0 0 0 0 0 1\n0 0 0 0 0 0 0 1\n")
    assert "two scans or more, in order of time" in lidarflow.complaint("export", "run", "--format", "tum")


def test_data_that_are_gone_or_moved(lidarflow, run, tmp_path):
    shutil.move(tmp_path / "data", tmp_path / "elsewhere")
    said = lidarflow.complaint("export", "run", "--format", "av2-v3")
    assert said.endswith("no such folder any more, and run was made from it; give --data with its new place")
    lidarflow.ok("export", "run", "--format", "ply")
    lidarflow.ok("export", "run", "--format", "av2-v3", "--data", "elsewhere")
    assert (tmp_path / "run-av2-v3" / "kitti_00" / "0.feather").is_file()
    provenance.write(run, provenance.RunSource(None, (0, 1, 2)))
    assert lidarflow.complaint("export", "run", "--format", "av2-v3").endswith(
        "run: was not made from a data folder; give --data")


def test_runs_of_images_have_poses_only(lidarflow, run, monkeypatch):
    monkeypatch.setattr("lidarflow.rgbd_io.is_rgbd_flow", lambda file: True)
    assert "is a run of RGB-D images; of those, only poses" in lidarflow.complaint(
        "export", "run", "--format", "ply")
    lidarflow.ok("export", "run", "--format", "tum")


def test_many_objects_fit_into_the_numbers_of_opensceneflow(tmp_path):
    from lidarflow.export import opensceneflow
    numbers = np.array([-1, 0, 40_000], np.int32)
    flow = np.zeros((3, 3))
    yes = np.ones(3, bool)
    flow_files.save_flow(tmp_path / "f.npz", flow, FlowResult(
        flow, pose.identity(3), yes, yes, yes, np.eye(4), STATS, object_id=numbers), config.Config())
    ids = opensceneflow._pair_arrays(flow_files.load_flow(tmp_path / "f.npz"))["flow_instance_id"]
    assert ids.tolist() == [0, 1, 32767]

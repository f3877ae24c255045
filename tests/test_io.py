"""Results on disk: the same bytes for the same input, never half a file, nothing foreign touched."""

import json
import os
import time
import zipfile
from dataclasses import replace

import numpy as np
import pytest
from cloud_files import message

from lidarflow import config as settings
from lidarflow import flow_files, io, pose, run_folder
from lidarflow.config import Config
from lidarflow.settings import updated
from lidarflow.types import FlowResult, SolveStats


def some_stats(**changes):
    numbers = {"variables": 4, "matches": 3, "edges": 3, "components": 1, "solved_components": 1,
               "plain_iterations": 5, "robust_iterations": 2, "plain_initial_error": 2.5,
               "plain_final_error": 0.5, "robust_initial_error": 0.5, "robust_final_error": 0.25,
               "inliers": 3}
    return SolveStats(solver="fast", stopped={"converged": 1}, **(numbers | changes))


def some_result(seconds=1.0):
    count = 5
    rng = np.random.default_rng(2)
    points = rng.normal(size=(count, 3)) * 10
    motions = pose.exp(rng.normal(size=(count, 6)) * 0.3)
    flow = pose.apply(motions, points) - points
    points[1] = flow[1] = np.nan
    valid, in_graph, is_dynamic, is_ground = rng.random((4, count)) < 0.5
    result = FlowResult(flow=flow, motions=motions, valid=valid, in_graph=in_graph,
                        is_dynamic=is_dynamic, ego_motion=pose.from_yaw(0.1, (1, 2, 3)),
                        stats=some_stats(), seconds={"solve": seconds},
                        object_id=np.arange(-1, count - 1), is_ground=is_ground)
    return points, result


@pytest.fixture
def saved(tmp_path):
    points, result = some_result()
    flow_files.save_flow(tmp_path / "flow.npz", points, result, Config())
    return tmp_path / "flow.npz"


def change(file, **changes):
    """Rewrite some arrays of an .npz file; None leaves one out."""
    with np.load(file) as archive:
        arrays = {name: archive[name] for name in archive.files} | changes
    np.savez(file, **{name: array for name, array in arrays.items() if array is not None})


# --- flow files ---

def test_a_flow_file_comes_back(saved):
    points, result = some_result()
    loaded = flow_files.load_flow(saved)
    np.testing.assert_allclose(loaded.points, points, rtol=1e-6)
    np.testing.assert_allclose(loaded.flow, result.flow, rtol=1e-5)
    np.testing.assert_allclose(loaded.motions, result.motions, atol=1e-5)
    back = loaded.result()
    for name in ("valid", "in_graph", "is_dynamic", "is_ground", "object_id", "ego_motion"):
        np.testing.assert_array_equal(getattr(loaded, name), getattr(result, name))
        np.testing.assert_array_equal(getattr(back, name), getattr(result, name))
    assert updated(Config(), loaded.config) == Config()
    assert SolveStats(**loaded.stats) == back.stats == result.stats
    np.testing.assert_allclose(back.flow, result.flow, rtol=1e-5)


def test_a_flow_file_is_the_stable_contract(saved):
    with np.load(saved, allow_pickle=False) as archive:
        found = {name: (archive[name].shape, archive[name].dtype.kind) for name in archive.files}
        dtypes = {name: archive[name].dtype for name in ("flow", "motion", "object", "ego_motion")}
    assert found["config"][1] == found["stats"][1] == "U"
    assert {found[name][1] for name in ("valid", "in_graph", "is_dynamic", "is_ground")} == {"b"}
    assert {name: shape for name, (shape, _) in found.items()} == {
        "points": (5, 3), "flow": (5, 3), "motion": (5, 7), "valid": (5,), "in_graph": (5,),
        "is_dynamic": (5,), "is_ground": (5,), "object": (5,), "std": (5,), "ego_motion": (4, 4),
        "config": (), "stats": ()}
    assert dtypes == {"flow": np.float32, "motion": np.float32, "object": np.int32, "ego_motion": np.float64}


def test_points_are_on_no_object_where_none_are_given(tmp_path):
    points, result = some_result()
    flow_files.save_flow(tmp_path / "a.npz", points, replace(result, object_id=None), Config())
    assert (flow_files.load_flow(tmp_path / "a.npz").object_id == -1).all()


def test_the_same_input_gives_the_same_bytes(tmp_path, monkeypatch):
    for name, years, seconds in (("a.npz", 0, 1.0), ("b.npz", 3, 9.0)):
        now = time.localtime(1.7e9 + years * 3.2e7)
        monkeypatch.setattr(time, "localtime", lambda *_, now=now: now)
        flow_files.save_flow(tmp_path / name, *some_result(seconds=seconds), Config())
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    with zipfile.ZipFile(tmp_path / "a.npz") as archive:
        assert {entry.date_time for entry in archive.infolist()} == {(1980, 1, 1, 0, 0, 0)}


def test_motions_that_are_nan_stay_nan(tmp_path):
    points, result = some_result()
    result.motions[1] = np.nan
    flow_files.save_flow(tmp_path / "a.npz", points, result, Config())
    motions = flow_files.load_flow(tmp_path / "a.npz").motions
    assert np.isnan(motions[1]).all() and pose.is_rigid(motions[[0, 2, 3, 4]], 1e-6)


def test_points_and_result_must_match(tmp_path):
    points, result = some_result()
    with pytest.raises(ValueError, match="do not match"):
        flow_files.save_flow(tmp_path / "a.npz", points[:3], result, Config())
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("changes, found", [
    ({"flow": None, "stats": None}, "not a flow file, lacks flow, stats"),
    ({"object": None}, "not a flow file, lacks object"),
    ({"object": np.zeros(5)}, "'object' is (5,) of float64"),
    ({"flow": np.zeros((5, 2), np.float32)}, "'flow' is (5, 2)"),
    ({"flow": np.float32(3)}, "is () of float32"),
    ({"motion": np.zeros((4, 7), np.float32)}, "'motion' is (4, 7) of float32; expected (5, 7)"),
    ({"valid": np.zeros(5)}, "'valid' is (5,) of float64"),
    ({"ego_motion": np.ones((4, 4))}, "damaged flow file"),
    ({"motion": np.zeros((5, 7), np.float32)}, "damaged flow file"),
    ({"config": np.array("{")}, "damaged flow file"),
    ({"stats": np.array("[1]")}, "damaged flow file"),
])
def test_a_flow_file_with_wrong_content(saved, changes, found):
    change(saved, **changes)
    assert found in message(flow_files.load_flow, saved)


def test_what_is_not_a_flow_file(tmp_path, saved):
    assert "no such file" in message(flow_files.load_flow, tmp_path / "none.npz")
    assert "is a folder" in message(flow_files.load_flow, tmp_path)
    (tmp_path / "text.npz").write_text("hello")
    assert "not an .npz archive" in message(flow_files.load_flow, tmp_path / "text.npz")
    np.save(tmp_path / "array.npy", np.zeros(3))
    assert "not an .npz archive" in message(flow_files.load_flow, tmp_path / "array.npy")
    content = saved.read_bytes()
    saved.write_bytes(content[:len(content) // 2])
    assert "truncated" in message(flow_files.load_flow, saved)
    saved.write_bytes(content[:200] + bytes(50) + content[250:])
    assert "not a readable flow file" in message(flow_files.load_flow, saved)


def test_pickles_are_never_loaded(saved):
    change(saved, config=np.array([{"a": 1}], dtype=object))
    assert "not a readable flow file" in message(flow_files.load_flow, saved)


# --- poses, settings, JSON ---

def test_poses_in_both_formats(tmp_path):
    world_from_sensor = np.stack([pose.from_yaw(0.3 * i, (10 * i, 1, 2)) for i in range(3)])
    io.write_poses_kitti(tmp_path / "k.txt", world_from_sensor)
    np.testing.assert_allclose(np.loadtxt(tmp_path / "k.txt").reshape(3, 3, 4), world_from_sensor[:, :3])
    io.write_poses_tum(tmp_path / "t.txt", world_from_sensor, [0, 1_317_042_145_951_199_337, np.int64(5)])
    lines = (tmp_path / "t.txt").read_text().splitlines()
    assert lines[1].startswith("1317042145.951199337 10 1 2 0 0 ") and lines[2].startswith("0.000000005 ")
    rows = np.array([line.split()[1:] for line in lines], float)
    np.testing.assert_allclose(pose.from_translation_quaternion(rows), world_from_sensor, atol=1e-9)


def test_objects_are_a_table(tmp_path):
    header = "frame,id,points,x,y,z,length,width,height,yaw,vx,vy,vz,speed_m_per_s\n"
    io.write_objects(tmp_path / "none.csv", [])
    assert (tmp_path / "none.csv").read_bytes().decode() == header
    row = ("a,b", 3, 120, *np.array([10.00004, -2, -0.00001, 4.5, 2, 1.5]), np.pi / 2, 3, 4.0, 0, 5)
    io.write_objects(tmp_path / "o.csv", [row, ("000001", 0, 9, *range(11))])
    assert (tmp_path / "o.csv").read_bytes().decode().removeprefix(header).splitlines() == [
        '"a,b",3,120,10.0000,-2.0000,0.0000,4.5000,2.0000,1.5000,1.5708,3.0000,4.0000,0.0000,5.0000',
        "000001,0,9," + ",".join(f"{k}.0000" for k in range(11))]


def test_json_has_no_nan(tmp_path):
    data = {"b": np.float32(np.nan), "a": [np.int64(3), np.bool_(True), float("inf")],
            "c": np.array([1.5, np.nan]), "d": None, "e": {"x": (1, "Grüße")}}
    io.write_json(tmp_path / "m.json", data)
    text = (tmp_path / "m.json").read_text(encoding="utf-8")
    assert json.loads(text) == {"a": [3, True, None], "b": None, "c": [1.5, None], "d": None,
                                "e": {"x": [1, "Grüße"]}}
    assert text.index('"a"') < text.index('"b"') and "NaN" not in text


def test_settings_come_back(tmp_path):
    config = settings.load(overrides=("mesh.max_edge_m=0.5", "ego.refine=false"))
    io.write_toml(tmp_path / "config.toml", config)
    assert settings.load(tmp_path / "config.toml") == config


# --- writing aside ---

def test_a_failed_write_leaves_the_old_file_and_no_rest(tmp_path):
    file = tmp_path / "a.txt"
    file.write_text("old")
    with pytest.raises(KeyboardInterrupt), io.written_aside(file) as aside:
        aside.write_text("half")
        raise KeyboardInterrupt
    assert file.read_text() == "old" and list(tmp_path.iterdir()) == [file]


def test_a_file_system_that_refuses(tmp_path):
    def fill_disk():
        with io.written_aside(tmp_path / "a.txt") as aside:
            aside.write_text("half")
            raise OSError(28, "No space left on device")

    text = message(fill_disk)
    assert text.startswith(f"cannot write {tmp_path / 'a.txt'}: No space left on device; free space or")
    assert not list(tmp_path.iterdir())
    (tmp_path / "file").touch()
    assert "cannot write" in message(io.write_json, tmp_path / "file" / "m.json", {})
    (tmp_path / "folder.json").mkdir()
    assert "cannot write" in message(io.write_json, tmp_path / "folder.json", {})


def test_missing_folders_are_made(tmp_path):
    io.write_json(tmp_path / "a" / "b" / "m.json", {})
    assert (tmp_path / "a" / "b" / "m.json").read_text() == "{}\n"


def test_folders_that_were_made_for_nothing_go_again(tmp_path):
    def fail(others=()):
        with pytest.raises(KeyboardInterrupt), io.written_aside(tmp_path / "a" / "b" / "m.json") as aside:
            aside.write_text("half")
            for other in others:
                other.touch()
            raise KeyboardInterrupt

    fail()
    assert not list(tmp_path.iterdir())
    fail(others=[tmp_path / "a" / "other.txt"])
    assert [file.name for file in tmp_path.rglob("*")] == ["a", "other.txt"]
    (tmp_path / "a" / "b").mkdir()
    fail()
    assert (tmp_path / "a" / "b").is_dir(), "it was there before"


# --- run folders ---

def test_a_run_folder_is_made_and_used_again(tmp_path):
    run = run_folder.make(tmp_path / "runs" / "a")
    assert (run / "flow").is_dir() and run_folder.make(run) == run, "a run cut short may be repeated"
    io.write_toml(run / "config.toml", Config())
    for name in ("flow/000007.npz", "metrics.json", "objects.csv", "notes.txt"):
        (run / name).write_text("old")
    run_folder.make(run)
    assert sorted(entry.name for entry in run.iterdir()) == ["config.toml", "flow", "notes.txt"]
    assert not list((run / "flow").iterdir()), "an old frame would count as one of the new run"


def test_foreign_folders_are_left_alone(tmp_path):
    (tmp_path / "thesis.tex").write_text("years of work")
    assert "not an earlier run's (thesis.tex)" in message(run_folder.make, tmp_path)
    (tmp_path / "config.toml").touch()
    assert "not an earlier run's" in message(run_folder.make, tmp_path)
    assert "is a file" in message(run_folder.make, tmp_path / "thesis.tex")
    assert sorted(os.listdir(tmp_path)) == ["config.toml", "thesis.tex"]
    (tmp_path / "empty").mkdir()
    assert (run_folder.make(tmp_path / "empty") / "flow").is_dir()


def test_latest_links_to_the_newest_run(tmp_path):
    for name in ("a", "b"):
        run = run_folder.make(tmp_path / name)
        assert run_folder.link_latest(run) == tmp_path / "latest"
        assert os.readlink(tmp_path / "latest") == name
    assert sorted(os.listdir(tmp_path)) == ["a", "b", "latest"]
    assert run_folder.link_latest(tmp_path / "latest") is None
    assert "is a link to the run in" in message(run_folder.make, tmp_path / "latest")


def test_a_real_folder_called_latest_stays(tmp_path):
    (tmp_path / "latest").mkdir()
    assert run_folder.link_latest(run_folder.make(tmp_path / "a")) is None
    assert (tmp_path / "latest").is_dir() and not (tmp_path / "latest").is_symlink()

"""Input that cannot be used: one clear line and exit code 1, or a valid result, and never half a file."""

import os
from pathlib import Path

import numpy as np
import pytest
from cloud_files import write_bin
from command_line import drive, rests

from lidarflow import flow_files, synthetic

pytestmark = pytest.mark.usefixtures("in_tmp_path")

RNG = np.random.default_rng(5)
GROUND = np.column_stack([RNG.uniform(-20, 20, (4000, 2)), np.full(4000, -1.73)])
WALL = np.column_stack([np.full(4000, 10.0), RNG.uniform(-15, 15, 4000), RNG.uniform(-1.5, 3, 4000)])


@pytest.fixture
def folder(tmp_path):
    """A folder of three good scans."""
    for k, (scan, _) in enumerate(drive()):
        write_bin(tmp_path / "scans" / f"{k:06d}.bin", scan.points)
    return tmp_path / "scans"


def truncate(file):
    file.write_bytes(file.read_bytes()[:-7])


# What a folder can lack.

def test_missing_and_unreadable_folders(lidarflow, tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "1.jpg").touch()
    (tmp_path / "file.bin").touch()
    for name, found in (("nowhere", "no such folder"), ("empty", "it is empty"), ("photos", "found 1 .jpg"),
                        ("file.bin", "expected a folder of scans"), ("x" * 300, "name too long")):
        assert found in lidarflow.complaint("run", name, "--out", "out"), name
    assert sorted(os.listdir(tmp_path)) == ["empty", "file.bin", "photos"]


def test_an_empty_path_is_not_the_working_folder(lidarflow, folder, monkeypatch):
    monkeypatch.chdir(folder)
    for words, name in ((("run", "", "--out", "../out"), "an argument"), (("run", ".", "--out", ""), "--out"),
                        (("run", ".", "--out="), "--out"), (("view", ""), "an argument"),
                        (("rgbd", "run", "", "--out", "../out"), "an argument")):
        assert lidarflow.complaint(*words).startswith(f"{name}: is empty; expected a value")
    assert sorted(os.listdir("..")) == ["scans"]


def test_a_sequence_of_one_scan(lidarflow, folder, tmp_path):
    for words, found in ((("-n", 1), "1 of 3 scans"), (("-j", 2), "1 of 3"), (("-j", 9), "0 of 3"),
                         (("-n", 0), "0 of 3"), (("-j", -1), "--jump -1"), (("-n", -2), "--n-scans -2")):
        said = lidarflow.complaint("run", folder, *words, "--out", "out")
        assert found in said and ("at least two" in said or "negative" in said)
    for file in list(folder.iterdir())[1:]:
        file.unlink()
    assert "1 of 1 scans" in lidarflow.complaint("run", folder, "--out", "out")
    assert not (tmp_path / "out").exists()


def test_a_sequence_that_is_not_there(lidarflow, tmp_path):
    synthetic.write_kitti(tmp_path / "kitti", drive())
    assert "there is 00" in lidarflow.complaint("run", "kitti", "-s", "07", "--out", "out")
    assert not (tmp_path / "out").exists()


# What a scan can lack.

@pytest.mark.parametrize("bad", [0, 1])
def test_a_damaged_first_pair_leaves_no_run_folder(lidarflow, folder, tmp_path, bad):
    truncate(folder / f"00000{bad}.bin")
    said = lidarflow.complaint("run", folder, "--out", "out")
    assert f"00000{bad}.bin" in said and "truncated" in said
    assert os.listdir(tmp_path) == ["scans"]


def test_a_damaged_scan_in_the_middle_keeps_what_was_done(lidarflow, folder, tmp_path):
    truncate(folder / "000002.bin")
    said = lidarflow.complaint("run", folder, "--out", "out")
    assert "000002.bin" in said and "truncated" in said and "kept in out/flow" in said
    assert sorted(os.listdir(tmp_path / "out")) == [
        ".resume", "config.toml", "flow", "source.json"]
    assert os.listdir(tmp_path / "out" / "flow") == ["000000.npz"]
    assert len(flow_files.load_flow(tmp_path / "out" / "flow" / "000000.npz").flow) == len(drive()[0][0])
    assert "cut short" in lidarflow.complaint("view", "out")


def test_an_empty_scan_in_the_middle(lidarflow, folder):
    (folder / "000002.bin").write_bytes(b"")
    said = lidarflow.complaint("run", folder, "--out", "out")
    assert "000002.bin" in said and "0 bytes" in said


@pytest.mark.parametrize("name, found", [
    ("truncated", "truncated"), ("no_bytes", "0 bytes"), ("all_nan", "empty scan"),
    ("ten", "registration needs 30"), ("millimetres", "metres"), ("kilometres", "metres"),
    ("one_place", "registration needs 30")])
def test_scans_that_cannot_be_used(lidarflow, folder, tmp_path, name, found):
    points = drive()[0][0].points
    clouds = {"all_nan": np.full((50, 3), np.nan), "ten": points[:10], "millimetres": points * 1000,
              "kilometres": points / 1000, "one_place": np.repeat(points[:1] * 0 + 5.0, 500, axis=0)}
    file = write_bin(tmp_path / "bad" / f"{name}.bin", clouds.get(name, points))
    if name == "truncated":
        truncate(file)
    if name == "no_bytes":
        file.write_bytes(b"")
    before = sorted(tmp_path.rglob("*"))
    for pair in ((file, folder / "000001.bin"), (folder / "000001.bin", file), (file, file)):
        assert found in lidarflow.complaint("pair", *pair, "--out", "new/flow.npz", "--picture", "p.png",
                                            "--recording", "r.rrd")
        assert sorted(tmp_path.rglob("*")) == before, "a failed pair leaves nothing"
    if "registration" in found:
        for method in ("ours", "ego"):
            assert f"{name}: registration: " in lidarflow.complaint(
                "pair", folder / "000001.bin", file, "--out", "flow.npz", "--method", method)


def test_clouds_that_are_no_files(lidarflow, folder):
    good = folder / "000000.bin"
    (folder / "notes.doc").touch()
    for other, found in ((folder, "is a folder"), ("absent.bin", "no such file"),
                         (folder / "notes.doc", "known are")):
        assert found in lidarflow.complaint("pair", good, other, "--out", "flow.npz")
        assert found in lidarflow.complaint("pair", other, good, "--out", "flow.npz")


# What is odd, but has an answer.

def valid_result(file, points):
    """The flow file, checked for what any valid result obeys."""
    found = flow_files.load_flow(file)
    finite = np.isfinite(points).all(axis=1)
    assert len(found.flow) == len(points)
    assert np.isfinite(found.flow[finite]).all() and np.isnan(found.flow[~finite]).all()
    assert not (found.valid[~finite].any() or found.is_dynamic[~finite].any())
    return found


def test_nan_rows_stay_in_their_places(lidarflow, folder, tmp_path):
    points = drive()[0][0].points.copy()
    points[::3] = np.nan
    points[1, 1] = np.inf
    write_bin(tmp_path / "nan.bin", points)
    lidarflow.ok("pair", "nan.bin", folder / "000001.bin", "--out", "flow.npz", "--picture", "p.png",
                 "--recording", "r.rrd")
    found = valid_result(tmp_path / "flow.npz", points)
    np.testing.assert_allclose(found.points[3001], points[3001], rtol=1e-6)
    lidarflow.ok("pair", folder / "000000.bin", "nan.bin", "--out", "flow.npz")
    valid_result(tmp_path / "flow.npz", drive()[0][0].points)
    assert not rests(tmp_path)


@pytest.mark.parametrize("points", [GROUND, WALL], ids=["ground", "wall"])
def test_all_points_on_one_plane(lidarflow, tmp_path, points):
    write_bin(tmp_path / "plane.bin", points)
    out = lidarflow.ok("pair", "plane.bin", "plane.bin", "--out", "flow.npz", "--picture", "p.png",
                       "--recording", "r.rrd")
    found = valid_result(tmp_path / "flow.npz", points)
    assert np.abs(found.flow).max() < 0.05 and not found.is_dynamic.any()
    assert "nan" not in out


def test_identical_scans_do_not_move(lidarflow, folder, tmp_path):
    out = lidarflow.ok("pair", folder / "000000.bin", folder / "000000.bin", "--out", "flow.npz")
    found = valid_result(tmp_path / "flow.npz", drive()[0][0].points)
    assert np.abs(found.flow).max() < 0.02 and not found.is_dynamic.any() and "0 moving by themselves" in out


def test_a_run_over_identical_scans(lidarflow, folder, tmp_path):
    for k in (1, 2):
        (folder / f"00000{k}.bin").write_bytes((folder / "000000.bin").read_bytes())
    lidarflow.ok("run", folder, "--out", "out")
    poses = np.loadtxt(tmp_path / "out" / "poses_kitti.txt").reshape(-1, 3, 4)
    np.testing.assert_allclose(poses, np.broadcast_to(np.eye(4)[:3], (3, 3, 4)), atol=0.01)


def test_scans_of_different_sensors(lidarflow, folder, tmp_path):
    rng = np.random.default_rng(0)
    scan = synthetic.scan_sequence(synthetic.street(rng), synthetic.hdl32e(columns=300), 1, rng)[0][0]
    write_bin(tmp_path / "hdl32.bin", scan.points)
    assert "one sensor?" in lidarflow.ok("pair", folder / "000000.bin", "hdl32.bin", "--out", "flow.npz")
    valid_result(tmp_path / "flow.npz", drive()[0][0].points)


# What settings and outputs can be.

def test_typos_in_settings_name_the_nearest(lidarflow, folder, tmp_path):
    (tmp_path / "typo.toml").write_text("[mesh]\nmax_egde_m = 0.5\n")
    (tmp_path / "section.toml").write_text("[mehs]\nmax_edge_m = 0.5\n")
    (tmp_path / "broken.toml").write_text("[mesh\n")
    for words, found in (
            (("--config", "typo.toml"), "typo.toml: unknown setting 'mesh.max_egde_m' - did you mean 'max_e"),
            (("--config", "section.toml"), "did you mean 'mesh'?"),
            (("--config", "broken.toml"), "not valid TOML"),
            (("--config", "absent.toml"), "no such settings file"), (("--config", "."), "cannot be read"),
            (("--set", "mesh.max_egde_m=1"), "did you mean 'max_edge_m'?"),
            (("--set", "mesh"), "expected section.name=value"),
            (("--set", "mesh.max_edge_m=wide"), "expected float"),
            (("--set", "mesh.max_edge_m=-1"), "expected ≥ 0.01"),
            (("--set", "mesh.method=grit"), "expected one of")):
        for command in (("run", folder, "--out", "out"), ("pair", folder, folder, "--out", "f.npz")):
            assert found in lidarflow.complaint(*command, *words)
    assert sorted(os.listdir(tmp_path)) == ["broken.toml", "scans", "section.toml", "typo.toml"]


def test_a_wrong_loader_names_the_nearest(lidarflow, folder):
    for name, found in (("kity", "did you mean 'kitti'?"), ("zzz", "argoverse2"),
                        ("argoverse2", "expected Argoverse 2"), ("range_images", "no numbered .png files")):
        assert found in lidarflow.complaint("run", folder, "--dataloader", name, "--out", "out")


def test_a_foreign_out_folder_is_left_alone_before_any_work(lidarflow, folder, tmp_path, monkeypatch):
    def no_work(*args):
        raise AssertionError("work was done for results that have no place")

    monkeypatch.setattr("lidarflow.runner.steps", no_work)
    monkeypatch.setattr("lidarflow.pipeline.estimate_flow", no_work)
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "text.tex").write_text("years of work")
    (tmp_path / "dir.npz").mkdir()
    for out, found in (("thesis", "not an earlier run's (text.tex)"), ("thesis/text.tex", "is a file"),
                       ("thesis/text.tex/run", "is a file"), (folder, "not an earlier run's")):
        assert found in lidarflow.complaint("run", folder, "--out", out)
    pair = folder / "000000.bin", folder / "000001.bin"
    for out, found in (("flow", "ending in .npz"), ("flow.npy", "ending in .npz"), ("dir.npz", "is a folder"),
                       ("thesis/text.tex/f.npz", "is a file")):
        assert found in lidarflow.complaint("pair", *pair, "--out", out)
    assert "--picture" in lidarflow.complaint("pair", *pair, "--out", "f.npz", "--picture", "p.jpg")
    assert "--recording" in lidarflow.complaint("pair", *pair, "--out", "f.npz", "--recording", "r.mcap")
    assert sorted(os.listdir(tmp_path)) == ["dir.npz", "scans", "thesis"]
    assert (tmp_path / "thesis" / "text.tex").read_text() == "years of work"


def test_the_input_is_never_overwritten(lidarflow, tmp_path):
    for k in (0, 1):
        np.savez(tmp_path / f"{k}.npz", points=drive()[k][0].points)
    before = (tmp_path / "1.npz").read_bytes()
    assert "is the input itself" in lidarflow.complaint("pair", "0.npz", "1.npz", "--out", "1.npz")
    assert (tmp_path / "1.npz").read_bytes() == before


def test_a_failed_write_leaves_nothing(lidarflow, folder, tmp_path, monkeypatch):
    def full(*args, **kwargs):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    pair = folder / "000000.bin", folder / "000001.bin"
    assert "No space left" in lidarflow.complaint("pair", *pair, "--out", "new/f.npz")
    assert not list(tmp_path.rglob("*.npz")) and not rests(tmp_path)


# view

def test_view_of_what_is_no_result(lidarflow, folder, tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "broken.npz").write_bytes(b"PK\x03\x04 cut")
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    (tmp_path / "page.rrd").write_text("<!DOCTYPE html>")
    (tmp_path / "none.rrd").touch()
    kinds = "no such file or folder; expected a run folder, a recording (.rrd) or a flow file (.npz)"
    for what, found in (("absent.npz", kinds), ("absent.rrd", kinds), ("absent", kinds),
                        ("page.rrd", "page.rrd: not a recording, it begins with b'<!DO'; expected"),
                        ("none.rrd", "not a recording"), ("empty", "no recording.rrd"),
                        ("broken.npz", "truncated"), ("other.npz", "not a flow file"),
                        (folder / "000000.bin", "expected a flow file")):
        for more in ((), ("--save", "new.rrd")):
            assert found in lidarflow.complaint("view", what, *more)
    assert "ending in .rrd" in lidarflow.complaint("view", "other.npz", "--save", "new.png")
    assert "expected a run folder or a flow file (.npz)" in lidarflow.complaint("eval", "absent")
    assert not list(tmp_path.glob("new.*")) and not rests(tmp_path)

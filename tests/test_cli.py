"""The command line: what it takes, what it writes, what it says."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from cloud_files import write_bin, write_numpy, write_pcd, write_ply
from command_line import drive, rests, rounded

from lidarflow import (
    __version__,
    cli,
    config,
    datasets,
    demo,
    flow_files,
    io,
    metrics,
    pair_reports,
    pose,
    rerun_streams,
    run_folder,
    settings,
    synthetic,
    tables,
)

CONTRACT = {"flow": ("float32", (3,)), "motion": ("float32", (7,)), "valid": ("bool", ()),
            "is_dynamic": ("bool", ()), "object": ("int32", ())}
RUN_FILES = {"config.toml", "flow", "metrics.json", "objects.csv", "poses_kitti.txt", "poses_tum.txt",
             "preview.png", "recording.rrd", "source.json", "timing.json"}
RUNS_THE_SAME = ("config.toml", "metrics.json", "objects.csv", "poses_kitti.txt", "poses_tum.txt",
                 "preview.png", "flow/000000.npz", "flow/000001.npz")
PROGRAM = [sys.executable, "-c", "from lidarflow.cli import main; main()"]
HEAVY = ("gtsam", "open3d", "numba", "rerun", "scipy", "kiss_icp", "PIL", "pyarrow", "numpy")
OFF = ("--set", "preparation.kitti_correction=off")
WRITE = {".bin": write_bin, ".npy": write_numpy,
         ".pcd": lambda file, points: write_pcd(file, "binary", points),
         ".ply": lambda file, points: write_ply(file, "binary_little_endian", points, kind="float")}


@pytest.fixture(scope="session")
def finished(kitti, tmp_path_factory):
    """(run folder, process) of a real `lidarflow run` over the drive."""
    out = tmp_path_factory.mktemp("results") / "a"
    done = real("run", kitti, *OFF, "--out", out)
    assert done.returncode == 0, done.stderr
    return out, done


def real(*words):
    """`lidarflow WORDS` in a process of its own, 80 columns wide."""
    return subprocess.run([*PROGRAM, *map(str, words)], capture_output=True, text=True, check=False,
                          env=os.environ | {"COLUMNS": "80"})


def fits_80_columns(text):
    return "…" not in text and all(len(line) <= 80 for line in text.splitlines())


# What answers at once.

def test_help_and_version_load_nothing_heavy():
    code = ("import sys\nfrom lidarflow import cli\nsys.argv = ['lidarflow', sys.argv[1]]\n"
            "try:\n    cli.main()\nfinally:\n"
            f"    print('LOADED', [m for m in {HEAVY} if m in sys.modules])")
    for option, expected in (("--help", "Dense rigid scene flow"), ("--version", f"lidarflow {__version__}")):
        words = [sys.executable, "-c", code, option]
        done = subprocess.run(words, capture_output=True, text=True, check=True)
        assert expected in done.stdout and done.stdout.endswith("LOADED []\n")


def test_help_names_every_command(lidarflow):
    out = lidarflow.ok("--help")
    for name in ("pair", "run", "compare", "eval", "report", "view", "demo", "config", "rgbd"):
        assert f"\n  {name} " in out
        assert all(len(line) <= 80 for line in lidarflow.ok(name, "--help").splitlines())
    assert "..." not in out.split("Commands:")[1]


def test_usage_errors_exit_with_2(lidarflow):
    for words in ("", "pear", "run", "run data", "pair a.bin", "run data --out o -n x"):
        code, _, err = lidarflow(*words.split())
        assert code == 2 and "Traceback" not in err


def test_config_shows_every_setting_and_its_default(lidarflow):
    out = lidarflow.ok("config")
    words = out.split()
    for name, default, _, effect in settings.describe(config.Config):
        assert name in words and effect.split()[0] in words
        assert default in words or f"{float(default):.4g}" in words
    assert fits_80_columns(out)


# pair

def test_pair_reads_every_format_alike(lidarflow, tmp_path):
    flows = []
    for suffix, write in WRITE.items():
        source, target = (write(tmp_path / f"{k}{suffix}", rounded(drive()[k][0].points)) for k in (0, 1))
        out = lidarflow.ok("pair", source, target, "--out", tmp_path / "deep" / f"{suffix}.npz")
        assert fits_80_columns(out.split("flow  ")[0]) and "seconds" in out
        with np.load(tmp_path / "deep" / f"{suffix}.npz") as archive:
            flows.append(archive["flow"])
            rows = len(drive()[0][0])
            for name, (dtype, shape) in CONTRACT.items():
                assert archive[name].dtype == dtype and archive[name].shape == (rows, *shape), name
            assert archive["ego_motion"].dtype == "float64" and archive["ego_motion"].shape == (4, 4)
            assert json.loads(str(archive["config"]))["mesh"] and json.loads(str(archive["stats"]))["solver"]
    for flow in flows[1:]:
        np.testing.assert_allclose(flow, flows[0], atol=1e-5)
    assert sorted(os.listdir(tmp_path / "deep")) == sorted(f"{suffix}.npz" for suffix in WRITE)


def test_pair_says_what_it_takes_for_granted(lidarflow, scans, tmp_path):
    told = lidarflow.ok("pair", *scans[:2], "--out", tmp_path / "flow.npz", "--method", "zero")
    assert "assumed    0.1 s between the scans; KITTI vertical-angle correction on\n" in told
    told = lidarflow.ok("pair", *scans[:2], "--out", tmp_path / "flow.npz", "--method", "zero", "--set",
                        "preparation.kitti_correction=off")
    assert "assumed    0.1 s between the scans\n" in told


def test_the_module_is_the_command_line(scans):
    done = subprocess.run([sys.executable, "-m", "lidarflow", "--version"], capture_output=True, text=True,
                          check=True)
    assert done.stdout.startswith("lidarflow ")


def test_what_has_no_effect_is_said(lidarflow, scans, tmp_path):
    pair = "pair", *scans[:2], "--out", tmp_path / "flow.npz"
    told = lidarflow.ok(*pair, "--method", "icp", "--solver", "gtsam", *OFF)
    assert "note       solver.method: no effect with --method icp\n" in told
    assert "no effect" not in lidarflow.ok(*pair, "--method", "icp", *OFF)
    told = lidarflow.ok("run", scans[0].parent, "--out", tmp_path / "run", "--method", "zero", "--no-record",
                        "--set", "ego.refine=false")
    assert "note       ego.refine: no effect with --method zero\n" in told
    told = lidarflow.ok("compare", scans[0].parent, "--methods", "zero,ego", "--set", "ego.voxel_m=0.3",
                        "--set", "ego.refine=false", "--set", "mesh.max_edge_m=0.3")
    assert [line for line in told.splitlines() if "no effect" in line] == [
        "note       mesh.max_edge_m: no effect with --method zero, ego",
        "note       ego.refine: no effect with ego.method = registration"]
    said = lidarflow.complaint(*pair, "--arrows")
    assert said.startswith("--arrows: nothing is shown or recorded") and "give --recording FILE.rrd" in said
    said = lidarflow.complaint("run", scans[0].parent, "--out", tmp_path / "a", "--arrows", "--no-record")
    assert "leave --no-record out" in said and not (tmp_path / "a").exists()


def test_pair_finds_the_ego_motion(lidarflow, scans, tmp_path):
    lidarflow.ok("pair", *scans[:2], "--out", tmp_path / "flow.npz", *OFF)
    found, truth = flow_files.load_flow(tmp_path / "flow.npz"), drive()[0][1]
    assert pose.translation_distance(found.ego_motion[None], truth.ego_motion[None])[0] < 0.03


def test_pair_draws_and_records_on_request(lidarflow, scans, tmp_path):
    lidarflow.ok("pair", *scans[:2], "--out", tmp_path / "f.npz", "--recording", tmp_path / "r" / "f.rrd",
                 "--picture", tmp_path / "p" / "f.png", "--arrows")
    assert (tmp_path / "r" / "f.rrd").read_bytes()[:3] == b"RRF"
    assert (tmp_path / "p" / "f.png").read_bytes()[1:4] == b"PNG"
    assert not rests(tmp_path)


def test_names_are_not_taken_for_markup(lidarflow, tmp_path):
    names = "[red]:car:[b].bin", "ü [1].bin"
    for name, (scan, _) in zip(names, drive(), strict=False):
        write_bin(tmp_path / "[s]" / name, scan.points)
    out = lidarflow.ok("pair", *(tmp_path / "[s]" / name for name in names), "--out", tmp_path / "[m].npz")
    assert str(tmp_path / "[m].npz") in out
    out = lidarflow.ok("run", tmp_path / "[s]", "--out", tmp_path / "[o]", "--no-record")
    assert "[red]:car:[b]" in out


def test_a_terminal_without_greek_letters_gets_the_results(scans, tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONIOENCODING", "ascii")
    done = real("pair", *scans[:2], "--out", tmp_path / "f.npz")
    assert done.returncode == 0 and "(? = 0.2 m)" in done.stdout, done.stderr


# run

def test_a_run_folder_holds_the_contract(finished):
    out, _ = finished
    assert set(os.listdir(out)) == RUN_FILES
    assert sorted(os.listdir(out / "flow")) == ["000000.npz", "000001.npz"]
    assert not rests(out.parent)
    for k in (0, 1):
        found = flow_files.load_flow(out / "flow" / f"00000{k}.npz")
        assert len(found.flow) == len(drive()[k][0])
        assert found.config["preparation"]["kitti_correction"] == "off"
    assert config.load(out / "config.toml") == config.load(overrides=OFF[1:])
    assert (out / "recording.rrd").read_bytes()[:3] == b"RRF"
    assert (out / "preview.png").read_bytes()[1:4] == b"PNG"
    assert os.readlink(out.parent / "latest") == "a"


def test_poses_of_a_run_follow_the_drive(finished):
    out, _ = finished
    rows = np.loadtxt(out / "poses_kitti.txt").reshape(-1, 3, 4)
    assert len(rows) == 3 and np.array_equal(rows[0], np.eye(4)[:3])
    world_from_last = np.eye(4)
    for _, truth in drive()[:2]:
        world_from_last = world_from_last @ pose.inverse(truth.ego_motion)
    assert np.linalg.norm(rows[-1][:, 3] - world_from_last[:3, 3]) < 0.05
    tum = np.loadtxt(out / "poses_tum.txt")
    assert tum.shape == (3, 8)
    np.testing.assert_allclose(tum[:, 0], [0, 0.1, 0.2], atol=1e-6)
    np.testing.assert_allclose(tum[:, 1:4], rows[:, :, 3], atol=1e-9)


def test_objects_of_a_run_are_boxes_around_their_points_that_move_as_they_do(finished):
    out, _ = finished
    header, *rows = (out / "objects.csv").read_text().splitlines()
    assert header == "frame,id,points,x,y,z,length,width,height,yaw,vx,vy,vz,speed_m_per_s"
    for k, frame in enumerate(("000000", "000001")):
        found, truth = flow_files.load_flow(out / "flow" / f"{frame}.npz"), drive()[k][1]
        over_ground = metres_over_ground(found.points, found.flow, found.ego_motion)
        true_over_ground = metres_over_ground(drive()[k][0].points, truth.flow, truth.ego_motion)
        of_frame = np.array([line.split(",")[1:] for line in rows if line.split(",")[0] == frame], float)
        assert sorted(of_frame[:, 0]) == sorted(set(found.object_id[found.object_id >= 0]))
        real_movers = 0
        for number, count, *numbers, speed in of_frame:
            centre, size, yaw, velocity = np.split(np.array(numbers), [3, 6, 7])
            on_it = found.object_id == number
            assert on_it.sum() == count and speed == pytest.approx(np.linalg.norm(velocity), abs=1e-3)
            box_from_source = pose.inverse(pose.from_yaw(yaw.item(), centre))
            in_box = pose.apply(box_from_source, found.points[on_it].astype(float))
            assert (np.abs(in_box) <= size / 2 + 1e-3).all()
            assert np.cos(np.arctan2(velocity[1], velocity[0]) - yaw) > 0.9999, "the length is the way"
            np.testing.assert_allclose(velocity, over_ground[on_it].mean(axis=0) / 0.1, atol=0.2)
            if truth.is_dynamic[on_it].all():
                real_movers += 1
                np.testing.assert_allclose(velocity, true_over_ground[on_it].mean(axis=0) / 0.1, atol=1.5)
        assert real_movers >= 3
    assert len(rows) == sum(line.startswith(("000000,", "000001,")) for line in rows)


def metres_over_ground(points, flow, ego_motion):
    """What points (N, 3) move by besides the sensor's own motion, in the source's axes."""
    return pose.apply(pose.inverse(ego_motion), points + flow) - points


def test_a_run_without_objects_says_so(lidarflow, scans, tmp_path):
    lidarflow.ok("run", scans[0].parent, "-n", 2, "--set", "objects.enabled=false", "--out",
                 tmp_path / "out", "--no-record")
    assert (tmp_path / "out" / "objects.csv").read_text().count("\n") == 1
    assert (flow_files.load_flow(tmp_path / "out" / "flow" / "000000.npz").object_id == -1).all()


def test_metrics_of_a_run_are_scores_against_the_truth(finished):
    scored = json.loads((finished[0] / "metrics.json").read_text())
    assert [row["frame"] for row in scored["pairs"]] == ["000000", "000001"]
    assert {row["truth"] for row in scored["pairs"]} == {"flow"}
    assert scored["mean"]["epe_static_m"] < 0.1 and scored["mean"]["ego_error_m"] < 0.05
    assert "seconds" not in json.dumps(scored), "wall times would make equal runs differ"


def test_a_run_can_be_scored_again(lidarflow, finished, tmp_path):
    lidarflow.ok("eval", finished[0], "--out", tmp_path / "again.json")
    first, again = (json.loads(file.read_text())
                    for file in (finished[0] / "metrics.json", tmp_path / "again.json"))
    assert again["mean"].keys() == first["mean"].keys() and again["truth"] == first["truth"] == "flow"
    for name, value in first["mean"].items():
        assert again["mean"][name] == pytest.approx(value, abs=2e-5), name
    assert again["by_range"][0]["all"]["points"] == first["by_range"][0]["all"]["points"]
    assert [pair.keys() for pair in again["pairs"]] == [pair.keys() for pair in first["pairs"]]
    for now, then in zip(again["pairs"], first["pairs"], strict=True):
        same = {"frame", "points", "graph_points", "moving_points", "objects", "truth", "stats"}
        assert {name: now[name] for name in same} == {name: then[name] for name in same}
        assert now["matches"] is None and then["matches"] > 0, "a flow file does not hold the matches"


def test_a_run_says_what_it_read_and_wrote_within_80_columns(finished):
    out, done = finished
    assert done.stderr == "", "no library may talk, no bar where there is no terminal"
    table = done.stdout.split("results  ")[0].split("\n\n", 1)[1]
    assert fits_80_columns(table) and "[m]" in table and "[%]" in table and "[s]" in table
    for word in ("000000", "000001", "mean", "3 scans", "kitti (guessed", "truth: flow",
                 str(out / "metrics.json"), f"lidarflow view {out}"):
        assert word in done.stdout


OVERRIDES = {True: (), False: ("objects.enabled=false",)}


@pytest.mark.parametrize("enabled", [True, False])
def test_the_widest_table_fits_80_columns(monkeypatch, capsys, enabled):
    """Up to ten columns, with the names and figures of a long drive; the graph's only without objects."""
    alignment = metrics.Alignment(0.741, 0.9, 0.969, 0.2)
    summary = metrics.ErrorSummary(100, 12.345, 1.2)
    part = metrics.MeanError(100, 0.1)
    scores = metrics.Scores(*[summary] * 5, *[metrics.Accuracy(*[0.1] * 5)] * 3,
                            metrics.ThreeWay(part, part, part, 1, 1, 1), None, (), (), *[0.1] * 7)
    reports = [
        pair_reports.PairReport(name, 123456, 5000, 123456, 42, 999, alignment, scores, "flow", None,
                                {"all": 999.9})
        for name in ("0000000000", "315966265259836000")]
    monkeypatch.setenv("COLUMNS", "80")
    cli._print(tables.run_table(reports, config.load(overrides=OVERRIDES[enabled])))
    out = capsys.readouterr().out
    assert fits_80_columns(out) and "0000000000 " in out
    assert out.count("12.345") == (6 if enabled else 12) and out.count("999.9") == 3
    assert out.count(" 42") == (3 if enabled else 0)
    assert "".join(line.split()[0] for line in out.splitlines() if line.startswith(("315", "836"))).isdigit()


def test_long_scan_names_are_shown_in_full(lidarflow, scans, tmp_path):
    names = [f"3159662652{k}9836000" for k in (5, 6)]
    for name, file in zip(names, scans, strict=False):
        (tmp_path / "in").mkdir(exist_ok=True)
        (tmp_path / "in" / f"{name}.bin").write_bytes(file.read_bytes())
    (tmp_path / "in" / "poses_kitti.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 2)
    out = lidarflow.ok("run", tmp_path / "in", "--out", tmp_path / "out", "--no-record")
    assert "…" not in out and "poses (every point taken as static)" in out and "time" in out
    assert names[0][:6] in out


def test_the_same_input_gives_the_same_bytes(lidarflow, finished, kitti, tmp_path):
    lidarflow.ok("run", kitti, *OFF, "--out", tmp_path / "b", "--no-record")
    for name in RUNS_THE_SAME:      # the ego-motion must not depend on how threads happen to add up
        assert (tmp_path / "b" / name).read_bytes() == (finished[0] / name).read_bytes(), name
    assert not (tmp_path / "b" / "recording.rrd").exists()


def test_a_run_may_start_later_and_end_earlier(lidarflow, scans, tmp_path):
    told = lidarflow.ok("run", scans[0].parent, "-j", 1, "-n", 2, "--out", tmp_path / "out", "--no-record")
    assert "replacing" not in told
    assert os.listdir(tmp_path / "out" / "flow") == ["000001.npz"]
    told = lidarflow.ok("run", scans[0].parent, "-n", 2, "--out", tmp_path / "out", "--no-record")
    assert f"replacing  {tmp_path / 'out'}: holds an earlier run" in told
    assert os.listdir(tmp_path / "out" / "flow") == ["000000.npz"], "an earlier run's would be taken for new"


def test_settings_come_from_the_file_then_from_set(lidarflow, scans, tmp_path):
    (tmp_path / "mine.toml").write_text("[mesh]\nmax_edge_m = 0.6\nmax_edge_rings = 1.5\n")
    lidarflow.ok("run", scans[0].parent.parent, "-n", 2, "--config", tmp_path / "mine.toml", "--set",
                 "mesh.max_edge_m=0.5", "--out", tmp_path / "out", "--no-record", "--dataloader", "kitti_raw")
    used = config.load(tmp_path / "out" / "config.toml")
    assert (used.mesh.max_edge_m, used.mesh.max_edge_rings) == (0.5, 1.5)


def test_scans_of_several_sensors_are_pointed_out(lidarflow, tmp_path):
    for k, points in enumerate((drive()[0][0].points, drive()[1][0].points[::3])):
        write_bin(tmp_path / "in" / f"{k}.bin", points)
    out = lidarflow.ok("run", tmp_path / "in", "--out", tmp_path / "out", "--no-record")
    assert "0.bin is more than 2 times as large as 1.bin" in out
    files = tmp_path / "in" / "0.bin", tmp_path / "in" / "1.bin"
    out = lidarflow.ok("pair", *files, "--out", tmp_path / "f.npz")
    assert "are both of one sensor?" in out


# latest

def test_latest_replaces_no_link_of_the_users(tmp_path):
    run = run_folder.make(tmp_path / "runs" / "a")
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "text").touch()
    for target in (tmp_path / "thesis", "../thesis"):
        (tmp_path / "runs" / "latest").symlink_to(target)
        assert run_folder.link_latest(run) is None and (tmp_path / "runs" / "latest" / "text").exists()
        (tmp_path / "runs" / "latest").unlink()


def test_latest_is_not_put_above_the_working_folder(tmp_path, monkeypatch):
    run_folder.make(tmp_path / "here")
    monkeypatch.chdir(tmp_path / "here")
    assert run_folder.link_latest(".") is None and os.listdir(tmp_path) == ["here"]


# view

def test_view_saves_a_flow_file_as_a_recording(lidarflow, finished, scans, tmp_path):
    file = finished[0] / "flow" / "000000.npz"
    for more in ([], ["--target", scans[1]]):
        assert "recording" in lidarflow.ok("view", file, *more, "--save", tmp_path / "a.rrd")
        assert (tmp_path / "a.rrd").read_bytes()[:3] == b"RRF" and os.listdir(tmp_path) == ["a.rrd"]


def test_view_saves_a_copy_of_a_runs_recording(lidarflow, finished, tmp_path):
    lidarflow.ok("view", finished[0], "--save", tmp_path / "copy.rrd")
    assert (tmp_path / "copy.rrd").read_bytes() == (finished[0] / "recording.rrd").read_bytes()


def test_view_opens_what_it_is_given(lidarflow, finished, monkeypatch):
    opened = []
    monkeypatch.setattr(
        rerun_streams, "open_in_viewer", lambda file: opened.append((file.name, file.is_file())))
    monkeypatch.setattr(rerun_streams, "require_display", lambda instead: None)
    for what in (finished[0], finished[0] / "recording.rrd", finished[0] / "flow" / "000001.npz"):
        lidarflow.ok("view", what)
    assert opened == [("recording.rrd", True), ("recording.rrd", True), ("flow.rrd", True)]
    said = lidarflow.complaint("view", finished[0], "--target", "scan.bin")
    assert said.startswith("--target scan.bin: is for a flow file")


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="only Linux sessions can lack a display")
def test_without_a_display_the_way_out_is_named(lidarflow, finished, scans, tmp_path, monkeypatch):
    monkeypatch.setattr(rerun_streams, "_viewer_listens", lambda: False)
    flow_file, out = finished[0] / "flow" / "000000.npz", tmp_path / "out"
    assert f"rerun --web-viewer {finished[0] / 'recording.rrd'}" in lidarflow.complaint("view", finished[0])
    assert f"lidarflow view {flow_file} --save" in lidarflow.complaint("view", flow_file)
    spaced = tmp_path.with_name("my flow.npz")
    shutil.copyfile(flow_file, spaced)
    assert f"lidarflow view '{spaced}' --save" in lidarflow.complaint("view", spaced)
    for words in (("run", scans[0].parent), ("pair", *scans[:2])):
        suffix = ".npz" if words[0] == "pair" else ""
        assert "display" in lidarflow.complaint(*words, "--visualize", "--out", f"{out}{suffix}")
    assert not os.listdir(tmp_path), "nothing is computed for a viewer that cannot open"


# demo

@pytest.mark.slow
def test_the_demo_runs_twice_into_one_folder(lidarflow, tmp_path, monkeypatch):
    monkeypatch.setattr(demo, "SCANS", 2)
    monkeypatch.setattr(synthetic, "hdl64e", lambda make=synthetic.hdl64e: make(columns=600))
    for _ in range(2):
        out = lidarflow.ok("demo", "--out", tmp_path / "demo")
        assert "2 scans with truth" in out and "truth: flow" in out
        assert set(os.listdir(tmp_path / "demo")) == {"data", "run", "latest"}
        assert os.listdir(tmp_path / "demo" / "run" / "flow") == ["000000.npz"]
    assert os.listdir(tmp_path) == ["demo"] and not rests(tmp_path)
    scored = json.loads((tmp_path / "demo" / "run" / "metrics.json").read_text())
    assert scored["mean"]["epe_static_m"] < 0.1


def test_the_demo_leaves_foreign_folders_alone(lidarflow, tmp_path):
    for name, found in (("a/thesis.tex", "thesis.tex"), ("b/data/x.bin", "not made by"),
                        ("c/run/x.txt", "x.txt"), ("d", "is a file")):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("mine")
        said = lidarflow.complaint("demo", "--out", tmp_path / name[0])
        assert found in said and "choose" in said and path.read_text() == "mine"
    assert sum(file.is_file() for file in tmp_path.rglob("*")) == 4


def test_an_interrupted_demo_leaves_no_half_of_its_data(tmp_path, monkeypatch):
    sequence = drive()     # made before the patch, which it would call
    monkeypatch.setattr(synthetic, "scan_sequence", lambda *args: sequence[:args[2]])

    def stop(folder, sequence):
        folder.mkdir(parents=True)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(synthetic, "write_kitti", stop)
        with pytest.raises(KeyboardInterrupt):
            demo.generate(tmp_path / "demo" / "data")
    assert os.listdir(tmp_path / "demo") == []
    demo.check_folder(tmp_path / "demo")
    for scans in (3, 2):
        assert len(datasets.open_dataset(demo.generate(tmp_path / "demo" / "data", scans))) == scans


@pytest.mark.skipif(os.name != "posix", reason="signals are sent the POSIX way")
@pytest.mark.parametrize("sent, code, told", [
    (signal.SIGINT, cli._INTERRUPTED, "interrupted"), (signal.SIGTERM, 128 + signal.SIGTERM, "terminated")])
def test_a_signal_is_one_line_and_leaves_only_whole_files(scans, tmp_path, sent, code, told):
    folder = tmp_path / "long"
    folder.mkdir()
    for k in range(20):
        (folder / f"{k:06d}.bin").write_bytes(scans[k % 2].read_bytes())
    # A shell's background jobs ignore the signal, and their children inherit that: tests may be among them.
    process = subprocess.Popen([*PROGRAM, "run", str(folder), "--out", str(tmp_path / "out")],
                               stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
                               preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler))
    line = process.stdout.readline()
    # In the middle of the work: an interrupt while native packages are imported is the packages' affair.
    # The first pair's checkpoint is there by then too.
    while not (tmp_path / "out" / "flow" / "000001.npz").exists() and process.poll() is None:
        time.sleep(0.01)
    process.send_signal(sent)
    _, err = process.communicate(timeout=60)
    assert "reading" in line and process.returncode == code
    assert err == (f"lidarflow: {told}; finished pairs are kept in {tmp_path / 'out'}, the same command with "
                   "--resume goes on\n")
    assert not rests(tmp_path)
    for file in (tmp_path / "out" / "flow").iterdir():
        flow_files.load_flow(file)
    assert all(io.is_whole(file) for file in tmp_path.rglob("*.npz"))


def test_solver_is_short_for_its_setting(lidarflow, scans, tmp_path):
    for name in ("gtsam", "fast"):
        lidarflow.ok("pair", *scans[:2], "--out", tmp_path / f"{name}.npz", "--solver", name)
        assert flow_files.load_flow(tmp_path / f"{name}.npz").config["solver"]["method"] == name
    told = lidarflow.complaint("pair", *scans[:2], "--out", tmp_path / "no.npz", "--solver", "slow")
    assert told.startswith("--solver: solver.method: expected one of fast, gtsam, got 'slow'")
    assert "solver.method" in lidarflow.ok("config")

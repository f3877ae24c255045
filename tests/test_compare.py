"""Baselines from the command line, and several methods beside each other."""

import json
import os

import numpy as np
import pytest
from command_line import drive, rests

from lidarflow import cli, compare, config, flow_files, methods, pose, tables
from lidarflow.config import Config
from lidarflow.datasets import open_dataset
from lidarflow.errors import ConfigError, DataError
from lidarflow.metrics import static_truth
from lidarflow.pipeline import FlowEstimator
from lidarflow.types import FlowResult, Scan, ScanPair, SolveStats

OFF = ("--set", "preparation.kitti_correction=off")
FAST = ["zero", "icp", "ego"]


# --- one method, instead of ours ---

@pytest.mark.parametrize("name", ["zero", "ego", "icp", "ransac_icp"])
def test_pair_by_any_method(lidarflow, scans, tmp_path, name):
    out = lidarflow.ok("pair", *scans[:2], "--method", name, "--out", tmp_path / "f.npz", *OFF,
                       "--recording", tmp_path / "f.rrd", "--picture", tmp_path / "f.png")
    assert f"method     {name}\n" in out and "found a match" not in out
    found = flow_files.load_flow(tmp_path / "f.npz")
    assert found.stats["solver"] == name and len(found.flow) == len(drive()[0][0])
    known = drive()[0][1].ego_motion
    assert (pose.translation_distance(found.ego_motion, known) < 0.05) == (name != "zero")
    assert sorted(os.listdir(tmp_path)) == ["f.npz", "f.png", "f.rrd"]


def test_a_run_of_a_baseline_is_a_run(lidarflow, kitti, tmp_path):
    out = lidarflow.ok("run", kitti, *OFF, "--method", "icp", "--out", tmp_path / "run")
    assert "method     icp\n" in out and "truth: flow" in out and "found a match" not in out
    assert {"recording.rrd", "preview.png", "objects.csv"} <= set(os.listdir(tmp_path / "run"))
    assert sorted(os.listdir(tmp_path / "run" / "flow")) == ["000000.npz", "000001.npz"]
    scored = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert {row["stats"]["solver"] for row in scored["pairs"]} == {"icp"}
    assert scored["mean"]["epe_static_m"] < 0.1 and scored["mean"]["movers_found"] == 0.0
    text = (tmp_path / "run" / "config.toml").read_text()
    assert text.startswith("# Method: icp\n")
    assert config.load(tmp_path / "run" / "config.toml") == config.load(overrides=OFF[1:])
    lidarflow.ok("view", tmp_path / "run", "--save", tmp_path / "copy.rrd")


def test_an_unknown_method_is_found_before_any_work(lidarflow, kitti, scans, tmp_path, monkeypatch):
    monkeypatch.setattr("lidarflow.runner.steps", None)
    known = "known are ours, zero, ego, icp, ransac_icp"
    out = tmp_path / "out"
    for words in (("pair", *scans[:2], "--method", "icq", "--out", f"{out}.npz"),
                  ("run", kitti, "--method", "icq", "--out", out),
                  ("compare", kitti, "--methods", "ours,icq")):
        assert lidarflow.complaint(*words) == f"unknown method 'icq'; {known}"
    assert f"names no method; {known}" in lidarflow.complaint("compare", kitti, "--methods", " ,")
    assert os.listdir(tmp_path) == []


def test_help_names_every_method(lidarflow):
    for command in ("pair", "run", "compare"):
        words = lidarflow.ok(command, "--help").replace(",", " ").replace(".", " ").split()
        assert set(methods.METHODS) <= set(words)


# --- several methods ---

def test_compare_prints_a_row_per_method(lidarflow, kitti, tmp_path):
    out = lidarflow.ok("compare", kitti, *OFF, "--methods", "ours,zero,icp,ransac_icp,ego",
                       "--out", tmp_path / "all.json")
    assert all(len(line) <= 80 for line in out.split("figures ")[0].splitlines())
    table = out.split("method ")[1].split("\n\n")[0].splitlines()
    assert [line.split()[0] for line in table[2:]] == ["ours", "zero", "icp", "ransac_icp", "ego"]
    assert "truth: flow" in out and "pairs: 2" in out
    written = json.loads((tmp_path / "all.json").read_text())
    assert written["config"]["preparation"]["kitti_correction"] == "off"
    assert written["frames"] == ["000000", "000001"] and written["truth"] == ["flow", "flow"]
    assert set(written["methods"]) == {"ours", "zero", "icp", "ransac_icp", "ego"}
    mean = {name: found["mean"] for name, found in written["methods"].items()}
    assert mean["ours"]["movers_found"] > 0.5 and mean["ransac_icp"]["movers_found"] == 0.0
    assert mean["ours"]["epe_dynamic_m"] < 0.5 * mean["ransac_icp"]["epe_dynamic_m"]
    assert mean["ransac_icp"]["t_e_m"] < 0.03 < 0.5 < mean["zero"]["t_e_m"]
    assert mean["zero"]["crispness"] < mean["ego"]["crispness"] < mean["ours"]["crispness"]
    for found in written["methods"].values():
        assert len(found["pairs"]) == len(found["seconds"]) == 2 and min(found["seconds"]) > 0
        assert found["median_seconds"] == pytest.approx(np.median(found["seconds"]))
        for name, value in found["mean"].items():
            assert value == pytest.approx(np.mean([pair[name] for pair in found["pairs"]]))
    assert not rests(tmp_path)


def test_compare_agrees_with_a_run(kitti):
    dataset = open_dataset(kitti, kitti_correction="off")
    found = compare.compare(dataset, [0, 1, 2], ["ego"], Config())
    estimator = FlowEstimator(Config())
    results = [estimator.step(dataset.scan(index)) for index in range(3)][1:]
    for k, (figures, result) in enumerate(zip(found.runs[0].figures, results, strict=True)):
        truth = dataset.truth(k)
        known = truth.valid & ~truth.is_dynamic
        moved = pose.apply(result.ego_motion, dataset.scan(k).points) - dataset.scan(k).points
        error_m = np.linalg.norm(moved - truth.flow, axis=1)[known].mean()
        assert figures["epe_static_m"] == pytest.approx(error_m, abs=1e-6)


class Counted:
    """A data set that notes which scans were read."""

    def __init__(self, dataset):
        self._dataset, self.read = dataset, []

    def __getattr__(self, name):
        return getattr(self._dataset, name)

    def scan(self, index):
        self.read.append(index)
        return self._dataset.scan(index)


def test_scans_are_read_once_for_all_methods(kitti):
    dataset, heard = Counted(open_dataset(kitti)), []
    found = compare.compare(dataset, [0, 1, 2], FAST, Config(), heard.append)
    assert dataset.read == [0, 1, 0, 1, 2], "a pair to warm up, then every scan"
    assert heard == found.frames == ["000000", "000001"]
    assert [len(run.seconds) for run in found.runs] == [2, 2, 2]


def test_without_truth_crispness_is_left(lidarflow, scans, tmp_path):
    for file in scans:
        (tmp_path / "in").mkdir(exist_ok=True)
        (tmp_path / "in" / file.name).write_bytes(file.read_bytes())
    out = lidarflow.ok("compare", tmp_path / "in", "--methods", "zero,icp", "-j", 1, "-n", 2)
    assert "truth: none found" in out and "crisp" in out and "EPE" not in out and "pairs: 1" in out


def test_problems_are_named_with_the_method_and_the_scan(lidarflow, scans, tmp_path):
    (tmp_path / "in").mkdir()
    for k in range(3):
        content = scans[0].read_bytes()
        (tmp_path / "in" / f"{k}.bin").write_bytes(content if k < 2 else content[:160])
    said = lidarflow.complaint("compare", tmp_path / "in", "--methods", "zero,icp")
    assert "registration needs 30" in said and "(method icp, scan 2 of in)" in said
    assert "at least two" in lidarflow.complaint("compare", tmp_path / "in", "-n", 1)
    assert "ending in .json" in lidarflow.complaint("compare", tmp_path / "in", "--out", tmp_path / "a.txt")


# --- scores, by hand ---

POINTS = np.array([[5.0, 0, 0], [10, 0, 0], [0, 20, 0], [0, 5, 0]])


def result_of(motion: np.ndarray) -> FlowResult:
    n = len(POINTS)
    none = np.zeros(n, bool)
    stats = SolveStats("by hand", 0, 0, 0, 0, 0, 0, 0, 0.0, 0.0, 0.0, 0.0, 0, {})
    return FlowResult(pose.apply(motion, POINTS) - POINTS, np.tile(motion, (n, 1, 1)), none, none, none,
                      motion, stats)


def test_figures_count_the_given_points_whatever_the_method_calls_valid():
    known = pose.from_translation(np.array([1.0, 0, 0]))
    pair = ScanPair(Scan(POINTS), Scan(pose.apply(known, POINTS)))
    truth = static_truth(POINTS, known)
    above_ground = np.array([True, True, False, False])
    right = compare.figures_of(pair, result_of(known), truth, above_ground, 0.2)
    assert right["crispness"] == 1.0 and right["t_e_m"] == right["r_e_rad"] == right["epe_static_m"] == 0.0
    assert np.isnan([right["epe_dynamic_m"], right["false_movers"]]).all(), "poses do not say what moves"

    # A tenth of a radian about the sensor: 2 r sin(0.05) at 5, 10, 20 and 5 m.
    turned = compare.figures_of(pair, result_of(known @ pose.from_yaw(0.1)), truth, above_ground, 0.2)
    chord = 2 * np.sin(0.05)
    assert turned["t_e_m"] == pytest.approx(7.5 * chord) and turned["r_e_rad"] == pytest.approx(0.1)
    assert turned["epe_static_m"] == pytest.approx(10.0 * chord)
    crisp = [np.exp(-(r * chord) ** 2 / (4 * 0.2**2)) for r in (5, 10)]
    assert turned["crispness"] == pytest.approx(np.mean(crisp))
    assert set(compare.figures_of(pair, result_of(known), None, above_ground, 0.2)) == {"crispness"}


def test_moving_points_have_no_part_in_the_paper_s_errors():
    known = pose.identity()
    truth = static_truth(POINTS, known)
    truth.is_dynamic[0] = True
    found = compare.figures_of(ScanPair(Scan(POINTS), Scan(POINTS)), result_of(pose.from_yaw(0.1)), truth,
                               np.ones(4, bool), 0.2)
    assert found["t_e_m"] == pytest.approx((10 + 20 + 5) / 3 * 2 * np.sin(0.05))
    assert found["movers_found"] == 0.0


def test_means_leave_out_what_is_not_known():
    run = compare.MethodRun("x", [{"a": 1.0, "b": np.nan, "c": np.nan}, {"a": 3.0, "b": 2.0, "c": np.nan}],
                            [5.0, 1.0])
    assert run.mean() == {"a": 2.0, "b": 2.0} and run.median_seconds() == 3.0


def test_methods_are_taken_once_and_in_order():
    assert compare.names_of("icp, ours,icp") == ["icp", "ours"]
    with pytest.raises(ConfigError, match="unknown method 'no'"):
        compare.names_of("icp,no")


def test_an_error_keeps_its_kind(kitti, monkeypatch):
    def fails(self, scan):
        raise DataError("nothing there")

    monkeypatch.setattr("lidarflow.baselines.zero.Zero.step", fails)
    with pytest.raises(DataError, match=r"^nothing there \(method zero, scan 0 of "):
        compare.compare(open_dataset(kitti), [0, 1], ["zero"], Config())


def test_the_widest_comparison_fits_80_columns(monkeypatch, capsys):
    figures = {"crispness": 0.987, "epe_static_m": 12.345, "epe_dynamic_m": 12.345, "t_e_m": 12.345,
               "r_e_rad": 0.0123, "movers_found": 1.0, "false_movers": 0.0123}
    runs = [compare.MethodRun("ransac_icp", [figures], [123.456])]
    found = compare.Comparison(runs, ["0"], ["flow"], Config())
    monkeypatch.setenv("COLUMNS", "80")
    cli._print(tables.compare_table(found))
    out = capsys.readouterr().out
    assert all(len(line) <= 80 for line in out.splitlines()) and "…" not in out
    assert out.splitlines()[-1].split() == [
        "ransac_icp", "0.987", "12.345", "12.345", "12.345", "0.0123", "100.00", "1.23", "123.46"]

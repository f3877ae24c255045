"""`lidarflow eval`: scores of results on disk, and one clear line where they cannot be scored."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from cloud_files import write_bin
from command_line import drive, rests
from run_folders import OFF_M, write_run

from lidarflow import evaluation, metrics, pair_reports, provenance, synthetic
from lidarflow.datasets import open_dataset
from lidarflow.types import Scan, Truth

pytestmark = pytest.mark.usefixtures("in_tmp_path")

SCANS = ("000000", "000001")
OFF = ("--set", "preparation.kitti_correction=off")


@pytest.fixture
def data(tmp_path):
    """Three generated scans in KITTI's layout, with truth and poses."""
    synthetic.write_kitti(tmp_path / "data", drive())
    return tmp_path / "data"


@pytest.fixture
def run(tmp_path, data):
    """A run over the data as `lidarflow run` leaves it: moving points right, all others off by OFF_M."""
    return write_run(tmp_path / "run", open_dataset(data, kitti_correction="off"), (0, 1, 2))


def truth_folder(data):
    return data / "sequences" / "00" / "truth"


def metrics_of(run_dir, name="metrics.json"):
    return json.loads((run_dir / name).read_text())


def check_scores(found, crisp_pairs=2):
    mean = found["mean"]
    assert mean["epe_static_m"] == pytest.approx(OFF_M, rel=1e-3) and mean["epe_dynamic_m"] < 1e-6
    assert mean["strict_accuracy"] == 1.0 and mean["dynamic_iou"] == 1.0 and mean["ego_error_m"] < 1e-6
    assert found["std"]["epe_static_m"] < 1e-6
    assert found["three_way"]["background_static"]["mean"] == pytest.approx(OFF_M, rel=1e-3)
    assert found["by_range"][0]["low_m"] == 0.0 and found["by_range"][-1]["high_m"] is None
    moving = sum(part["dynamic"]["points"] for part in found["by_speed"])
    assert moving == sum(truth.is_dynamic.sum() for _, truth in drive()[:2])
    assert [pair["frame"] for pair in found["pairs"]] == list(SCANS)
    crisp = [pair["alignment"]["after"] for pair in found["pairs"]]
    assert sum(value is not None for value in crisp) == crisp_pairs and crisp[0] > 0.8
    assert found["crispness_sigma_m"] == 0.3, "the run's own setting"


def test_a_run_is_scored_against_the_truth_of_its_data(lidarflow, data, run):
    out = lidarflow.ok("eval", "run")
    check_scores(metrics_of(run))
    assert f"truth      flow, from {data}" in out and "metrics    run/metrics.json" in out
    for word in ("000001", "strict accuracy", "three-way", "by range", "35 to 50", "by speed", "ego-motion"):
        assert word in out
    assert all(len(line) <= 80 for line in out.splitlines()[3:]) and "…" not in out
    assert "[s]" not in out, "seconds are of the run, not of the scores"
    assert not rests(run)


def test_scores_go_where_they_are_wanted(lidarflow, run, tmp_path):
    assert "metrics    m.json" in lidarflow.ok("eval", "run", "--out", "m.json")
    check_scores(metrics_of(tmp_path, "m.json"))
    assert not (run / "metrics.json").exists()
    assert "ending in .json" in lidarflow.complaint("eval", "run", "--out", "m.txt")


def test_data_that_moved_are_found_again(lidarflow, data, run):
    data.rename(data.parent / "elsewhere")
    said = lidarflow.complaint("eval", "run")
    assert said == (f"{data}: no such folder any more, and run was made from it; give --data with its new "
                    "place, or --truth")
    assert "from " + str(data.parent / "elsewhere") in lidarflow.ok("eval", "run", "--data", "elsewhere")
    check_scores(metrics_of(run))


def test_a_truth_folder_will_do(lidarflow, data, run):
    lidarflow.ok("eval", "run", "--truth", truth_folder(data))
    check_scores(metrics_of(run))
    shutil.move(truth_folder(data), "truth")
    shutil.rmtree(data)
    (run / "metrics.json").unlink()
    said = lidarflow.ok("eval", "run", "--truth", "truth")
    check_scores(metrics_of(run), crisp_pairs=1)
    assert ("note       crispness of 000001 is not known, and no part of the mean: the next scan is in "
            f"{data}, which is gone\n") in said


def test_crispness_that_was_recorded_is_kept_where_the_data_are_gone(lidarflow, data, run):
    lidarflow.ok("eval", "run")
    before = metrics_of(run)
    shutil.move(truth_folder(data), "truth")
    shutil.rmtree(data)
    said = lidarflow.ok("eval", "run", "--truth", "truth")
    assert f"crispness of 000001 is what the run recorded: the next scan is in {data}, which is gone" in said
    assert metrics_of(run) == before
    (run / "metrics.json").write_text(json.dumps(before | {"pairs": [{"frame": "000001"}]}))
    assert "crispness of 000001 is not known" in lidarflow.ok("eval", "run", "--truth", "truth")
    provenance.write(run, provenance.RunSource(None, (0, 1, 2)))
    assert "the next scan is not at hand" in lidarflow.ok("eval", "run", "--truth", "truth")


def test_a_flow_file_is_scored_against_a_truth_file(lidarflow, data, run, tmp_path):
    file, truth = run / "flow" / "000000.npz", truth_folder(data) / "000000.npz"
    for place in (truth, truth.parent):
        out = lidarflow.ok("eval", file, "--truth", place, "--out", "m.json")
    found = metrics_of(tmp_path, "m.json")
    assert found["mean"]["epe_static_m"] == pytest.approx(OFF_M, rel=1e-3) and found["truth"] == "flow"
    assert "metrics    m.json" in out and "metrics" not in lidarflow.ok("eval", file, "--truth", truth)
    said = lidarflow.complaint("eval", file, "--truth", truth, "--data", data)
    assert said.startswith(f"--data {data}: is for a run folder; the flow file {file} needs")


def test_poses_alone_make_a_static_scene(lidarflow, data, run):
    assert "false" in lidarflow.ok("eval", "run")
    shutil.rmtree(truth_folder(data))
    out = lidarflow.ok("eval", "run")
    assert "truth      poses (every point taken as static)" in out
    assert "false" not in out, "poses do not say what moves"
    mean = metrics_of(run)["mean"]
    assert mean["epe_static_m"] > 1.05 * OFF_M, "movers count as static"
    assert "epe_dynamic_m" not in mean


def test_a_run_takes_no_poses_for_truth_beside_a_better_one(lidarflow, data, tmp_path):
    """Whichever pair lacks its file: truths are known one by one, while the run goes on."""
    for lacks, has in (SCANS, SCANS[::-1]):
        (truth_folder(data) / f"{lacks}.npz").rename(tmp_path / "aside.npz")
        out = lidarflow.ok("run", data, *OFF, "--method", "zero", "--no-record", "--out", "mixed")
        assert "none (1 pair)" in out and "flow (1 pair)" in out
        found = metrics_of(tmp_path / "mixed")
        scores = {pair["frame"]: pair["scores"] for pair in found["pairs"]}
        assert scores[lacks] is None
        assert found["mean"]["epe_static_m"] == scores[has]["static"]["mean"]
        assert "flow (1 pair)" in found["truth"] and "none (1 pair)" in found["truth"]
        assert "three_way" not in found, "not of all pairs"
        lidarflow.ok("report", "mixed")
        out = lidarflow.ok("compare", data, *OFF, "--methods", "zero", "--out", "all.json")
        assert "none (1 pair)" in out
        compared = metrics_of(tmp_path, "all.json")["methods"]["zero"]["pairs"]
        assert set(compared[SCANS.index(lacks)]) == {"crispness"}
        (tmp_path / "aside.npz").rename(truth_folder(data) / f"{lacks}.npz")


def test_figures_of_two_kinds_of_truth_are_not_pooled(data, run):
    done = evaluation.evaluate_run(run)
    first, second = done.reports
    assert pair_reports.pooled(done.reports) is not None
    assert pair_reports.pooled([first, replace(second, truth="boxes")]) is None
    assert pair_reports.truth_of(["boxes", "flow", "flow"]) == "boxes (1 pair), flow (2 pairs)"
    assert pair_reports.poorer(["flow", metrics.POSES_ONLY, "none"]) == [1]
    assert pair_reports.poorer(["none", metrics.POSES_ONLY]) == []


def test_classes_of_the_truth_are_scored(lidarflow, data, run):
    for name in SCANS:
        file = truth_folder(data) / f"{name}.npz"
        with np.load(file) as archive:
            arrays = dict(archive)
        ground = ~arrays["dynamic"] & (np.arange(len(arrays["flow"])) % 2 == 0)
        np.savez(file, **arrays, category=np.where(arrays["dynamic"], 1, 0), is_ground=ground)
    assert "bucketed error" in lidarflow.ok("eval", "run")
    found = metrics_of(run)
    static = sum(part["static"]["points"] for part in found["by_speed"])
    assert found["three_way"]["background_static"]["points"] < 0.6 * static, "ground is left out"
    found = found["bucketed"]
    assert found["classes"]["BACKGROUND"]["static_m"] == pytest.approx(OFF_M, rel=1e-3)
    assert found["classes"]["CAR"]["dynamic"] < 1e-5 and found["classes"]["PEDESTRIAN"]["dynamic"] is None


# One clear line each.

def test_truth_of_another_length(lidarflow, data, run):
    file = truth_folder(data) / "000001.npz"
    with np.load(file) as archive:
        cut = {name: array[:-1] if len(array) > 4 else array for name, array in archive.items()}
    rows = len(cut["flow"])
    np.savez(file, **cut)
    for words in (("run",), ("run", "--truth", truth_folder(data)),
                  (run / "flow" / "000001.npz", "--truth", file)):
        said = lidarflow.complaint("eval", *words)
        assert f"{rows} rows, but 000001" in said and f"has {rows + 1} points; expected one row" in said
    assert not (run / "metrics.json").exists()


def test_flow_of_a_scan_is_missing(lidarflow, data, run):
    (run / "flow" / "000000.npz").rename(run / "flow" / "000007.npz")
    assert "no flow of scan 000000 (2 flow files for 2 pairs)" in lidarflow.complaint("eval", "run")
    (run / "flow" / "000007.npz").unlink()
    assert "run cut short" in lidarflow.complaint("eval", "run")
    shutil.move(truth_folder(data), "truth")
    shutil.rmtree(data)
    assert "1 flow files for 2 pairs" in lidarflow.complaint("eval", "run", "--truth", "truth")
    (run / "flow" / "000001.npz").unlink()
    assert "no flow files in flow" in lidarflow.complaint("eval", "run")


def test_flow_of_a_scan_too_many(lidarflow, run):
    shutil.copy(run / "flow" / "000001.npz", run / "flow" / "000009.npz")
    assert "flow of 000009, which is no scan of kitti 00" in lidarflow.complaint("eval", "run")


def test_truth_of_a_scan_is_missing(lidarflow, data, run):
    (truth_folder(data) / "000001.npz").unlink()
    assert "no truth of 000001, but of the other scans" in lidarflow.complaint("eval", "run")
    said = lidarflow.complaint("eval", "run", "--truth", truth_folder(data))
    assert "no 000001.npz, the truth of scan 000001 (1 other .npz files)" in said
    one = truth_folder(data) / "000000.npz"
    assert "the truth of one scan for 2 pairs" in lidarflow.complaint("eval", "run", "--truth", one)
    assert "no such file or folder" in lidarflow.complaint("eval", "run", "--truth", "nowhere")


def test_a_run_without_truth(lidarflow, tmp_path):
    for k in range(3):
        write_bin(tmp_path / "scans" / f"{k:06d}.bin", drive()[k][0].points)
    write_run(tmp_path / "run", open_dataset("scans"), (0, 1, 2))
    assert "no truth (neither flow, nor boxes and poses, nor poses); give --truth" in lidarflow.complaint(
        "eval", "run")
    assert "a flow file alone has no truth" in lidarflow.complaint("eval", "run/flow/000000.npz")


def test_a_run_from_no_folder(lidarflow, run):
    provenance.write(run, provenance.RunSource(None, (0, 1, 2)))
    assert "was not made from a data folder; give --truth FOLDER" in lidarflow.complaint("eval", "run")


def test_data_of_another_run(lidarflow, run, tmp_path):
    first, (scan, truth), last = drive()
    synthetic.write_kitti(tmp_path / "shifted", [first, (Scan(scan.points + 0.5), truth), last])
    said = lidarflow.complaint("eval", "run", "--data", "shifted")
    assert "its points are not those of scan 000001" in said and "0.866 m apart" in said
    synthetic.write_kitti(tmp_path / "short", [first, (scan, truth)])
    assert "2 scans, but run goes up to scan 2" in lidarflow.complaint("eval", "run", "--data", "short")
    cut = Truth(truth.flow[1:], truth.ego_motion, truth.valid[1:], truth.is_dynamic[1:], truth.object_id[1:])
    synthetic.write_kitti(tmp_path / "cut", [first, (Scan(scan.points[1:]), cut), last])
    said = lidarflow.complaint("eval", "run", "--data", "cut")
    assert f"{len(scan)} points, but scan 000001 of kitti 00 has {len(scan) - 1}; is this the data" in said


def test_another_scan_in_the_place_of_the_last(lidarflow, data, run):
    lidarflow.ok("eval", "run")
    scans = data / "sequences" / "00" / "velodyne"
    (scans / "000002.bin").unlink()
    write_bin(scans / "000003.bin", drive()[2][0].points + [1.0, 0, 0])
    said = lidarflow.complaint("eval", "run")
    assert "scan 000003 is not the one that the flow of 000001 leads to: crispness before any motion" in said
    assert "as in run/metrics.json; is this the data of the run?" in said
    assert lidarflow.complaint("eval", "run", "--truth", truth_folder(data)) == said
    (run / "metrics.json").unlink()
    lidarflow.ok("eval", "run", "--truth", truth_folder(data))


def test_what_is_no_run(lidarflow, data, run):
    assert "no source.json" in lidarflow.complaint("eval", data)
    assert "no such file" in lidarflow.complaint("eval", "nowhere")
    file = run / "flow" / "000001.npz"
    with np.load(file) as archive:
        np.savez(file, **{**archive, "stats": np.array("{}")})
    assert "000001.npz: damaged flow file (SolveStats" in lidarflow.complaint("eval", "run")
    (run / "source.json").write_text('{"scans": [0, 1, 2], "data": 5, "loader": "kitti"}')
    assert "damaged (KeyError" in lidarflow.complaint("eval", "run")
    (run / "source.json").write_text('{"scans": [3]}')
    assert "damaged (ValueError: scans must be two" in lidarflow.complaint("eval", "run")
    (run / "source.json").write_text("{")
    assert "damaged" in lidarflow.complaint("eval", "run")

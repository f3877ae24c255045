"""`lidarflow report`: one page with the right numbers, safe to open; one clear line where it cannot be."""

import base64
import io as memory
import itertools
import json
import re
import shutil
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from command_line import drive, rests
from PIL import Image
from run_folders import CONFIG, OFF_M, write_run
from test_preview import MOVER, street

from lidarflow import (
    evaluation,
    flow_files,
    io,
    metrics,
    pair_reports,
    preview,
    provenance,
    report,
    synthetic,
)
from lidarflow.datasets import open_dataset
from lidarflow.pair_reports import PairReport
from lidarflow.report import pictures, plots, reading
from lidarflow.report.page import settings_tables
from lidarflow.report.rebuilding import rebuilt
from lidarflow.types import Truth

pytestmark = pytest.mark.usefixtures("in_tmp_path")

EVIL = "<script>alert(1)<"     # a folder's name holds no slash


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A scored run over three generated scans: moving points right, all others off by OFF_M."""
    place = tmp_path_factory.mktemp("made")
    synthetic.write_kitti(place / "data", drive())
    run = write_run(place / "run", open_dataset(place / "data", kitti_correction="off"), (0, 1, 2))
    io.write_json(run / "metrics.json", evaluation.evaluate_run(run).metrics())
    return place


@pytest.fixture
def run(made, tmp_path):
    """A copy of the run that a test may damage; its data are not copied."""
    return shutil.copytree(made / "run", tmp_path / "run")


class Reader(HTMLParser):
    """Tags with attributes, and rows of all tables, of a page."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.rows, self._cell = [], [], None
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self._cell = dict(attributes).get("class", "")
            self.rows[-1].append("")

    def handle_endtag(self, tag):
        if tag in ("td", "th"):
            self._cell = None

    def handle_data(self, data):
        if self._cell is not None:
            self.rows[-1][-1] += ("*" if self._cell == "best" else "") + data

    def row(self, title):
        """The other cells of the first row of that title."""
        return next(row[1:] for row in self.rows if row and row[0] == title)

    def of(self, tag):
        return [attributes for name, attributes in self.tags if name == tag]


def page_of(lidarflow, *runs):
    assert lidarflow.ok("report", *runs, "--out", "page.html") == "report     page.html\n"
    with open("page.html", encoding="utf-8") as file:
        return file.read()


def test_the_page_holds_the_figures(lidarflow, run, made):
    text = page_of(lidarflow, run)
    read = Reader(text)
    found = json.loads((run / "metrics.json").read_text())
    mean, std = found["mean"], found["std"]
    assert read.row("end-point error, static [m]") == [f"{OFF_M:.3f} ± 0.000"]
    assert read.row("end-point error, moving [m]") == ["0.000 ± 0.000"]
    assert read.row("moving points found [%]") == ["100.00 ± 0.00"]
    crisp = f"{mean['crispness_after']:.3f} ± {std['crispness_after']:.3f}"
    assert read.row("crispness by the flow") == [crisp]
    part = found["three_way"]["background_static"]
    assert read.row("background static") == [str(part["points"]), f"{OFF_M:.3f}"]
    near = found["by_range"][0]
    assert read.row("0 to 35") == [str(near["all"]["points"]), *(
        f"{near[kind]['mean']:.3f}" for kind in ("all", "static", "dynamic"))]
    assert read.row("000001")[0] == f"{found['pairs'][1]['scores']['static']['mean']:.3f}"
    assert f"{made / 'data'} (kitti)" in text and "0 to 2, 2 pairs" in text
    assert "2 of 2 pairs pictured" in text
    for word in ("Crispness over time", "by range [m]", "by speed [m a frame]", "2.0 cm", "100.0 %"):
        assert word in text
    assert not rests(run.parent)


def test_means_over_pairs_are_told_from_figures_of_all_points(lidarflow, run):
    found = json.loads((run / "metrics.json").read_text())
    found["mean"] |= {"bucketed_static_m": 0.111, "bucketed_dynamic": 0.222, "epe_three_way_m": 0.333,
                      "dynamic_iou": 0.444}
    found["std"] |= dict.fromkeys(("bucketed_static_m", "bucketed_dynamic", "epe_three_way_m"), 0.0)
    errors = {"static_m": 0.555, "dynamic": 0.666}
    found["bucketed"] = {"mean": errors, "classes": {"CAR": errors}}
    io.write_json(run / "metrics.json", found)
    read = Reader(page_of(lidarflow, run))
    of_a_pair = {row[0]: row[1] for row in read.rows if len(row) == 2 and " of a pair" in row[0]}
    assert of_a_pair == {
        "bucketed error of a pair, static [m]": "0.111 ± 0.000",
        "bucketed error of a pair, moving, of speed": "0.222 ± 0.000",
        "three-way error of a pair [m]": "0.333 ± 0.000", "dynamic IoU of a pair": "0.444 ± 0.000"}
    whole = read.rows.index(["bucketed error, points of all pairs, |x|, |y| < 35 m", "static [m]",
                             "moving, of speed"])
    assert read.rows[whole + 1] == ["car", "0.555", "0.666"]
    assert read.row("three-way error, points of all pairs, |x|, |y| ≤ 50 m") == ["points", "[m]"]


def test_changed_settings_stand_out(lidarflow, run):
    read = Reader(page_of(lidarflow, run))
    assert read.row("crispness.sigma_m")[:2] == ["0.3", "0.2"]
    assert read.row("preparation.kitti_correction")[:2] == ["off", "auto"]
    assert read.row("mesh.method")[0] == "auto"
    changed, kept = settings_tables(CONFIG)
    assert len(changed.rows) == 2 and not {row[0] for row in changed.rows} & {row[0] for row in kept.rows}


def test_the_page_needs_nothing_else(lidarflow, run):
    text = page_of(lidarflow, run)
    read = Reader(text)
    assert len(text) < 5_000_000 and not re.search(r"https?://|url\(|@import", text)
    assert not {"script", "link", "iframe", "object"} & {tag for tag, _ in read.tags}
    for _, attributes in read.tags:
        assert not {name for name in attributes if name.startswith("on")}
        assert attributes.get("src", "data:").startswith("data:") and "href" not in attributes
    sources = [image["src"] for image in read.of("img")]
    assert len(sources) == 4, "motion and errors of two pairs"
    for source in sources:
        data = base64.b64decode(source.removeprefix("data:image/png;base64,"), validate=True)
        assert Image.open(memory.BytesIO(data)).size == (pictures.SIZE_PX, pictures.SIZE_PX)


def test_equal_runs_give_equal_bytes(lidarflow, run):
    assert page_of(lidarflow, run) == page_of(lidarflow, run)


def test_names_are_text_not_markup(lidarflow, run, tmp_path):
    evil = tmp_path / EVIL / "script>"     # <script>alert(1)</script> as a path
    shutil.copytree(run, evil)
    source = provenance.read(run)
    moved = tmp_path / "<img src=x onerror=alert(2)>"
    shutil.copytree(source.dataset.folder, moved)
    provenance.write(evil, provenance.RunSource(replace(source.dataset, folder=moved), source.scans))
    found = json.loads((evil / "metrics.json").read_text())
    found["pairs"][0]["frame"] = "<i>0"
    (evil / "flow" / "000000.npz").rename(evil / "flow" / "<i>0.npz")
    io.write_json(evil / "metrics.json", found)
    text = page_of(lidarflow, evil, run)
    assert "&lt;script&gt;alert(1)&lt;/script&gt;" in text and "&lt;img src=x onerror=alert(2)&gt;" in text
    assert "<script" not in text and "<img src=x" not in text and "<i>0" not in text
    assert "&lt;i&gt;0" in text


def test_runs_of_the_same_data_are_compared(lidarflow, run, made, tmp_path):
    worse = shutil.copytree(run, tmp_path / "worse")
    found = json.loads((worse / "metrics.json").read_text())
    found["mean"] |= {"epe_static_m": 2 * OFF_M, "strict_accuracy": 0.5, "crispness_after": 0.99}
    io.write_json(worse / "metrics.json", found)
    text = page_of(lidarflow, worse, run)
    read = Reader(text)
    assert read.rows[0] == ["mean over pairs", "worse", "run"]
    assert read.row("end-point error, static [m]") == [f"{2 * OFF_M:.3f}", f"*{OFF_M:.3f}"]
    assert read.row("strict accuracy [%]") == ["50.00", "*100.00"]
    assert read.row("moving points found [%]") == ["100.00", "100.00"], "none is better"
    assert "*" in read.row("crispness by the flow")[0]
    found["mean"] |= {"crispness_before": 0.1}
    del found["mean"]["strict_accuracy"]
    io.write_json(worse / "metrics.json", found)
    read = Reader(page_of(lidarflow, worse, run))
    assert "*" not in "".join(read.row("crispness by the flow")), "of other points"
    assert read.row("strict accuracy [%]") == ["-", "100.00"], "there is nothing to be better than"
    assert text.index("The runs compared") < text.index("2 of 2 pairs pictured")


def test_runs_of_other_data_are_not_ranked(lidarflow, run, tmp_path):
    other = shutil.copytree(run, tmp_path / "other")
    provenance.write(other, provenance.RunSource(provenance.read(run).dataset, (1, 2)))
    found = json.loads((other / "metrics.json").read_text())
    found["pairs"] = found["pairs"][1:]
    found["mean"]["epe_static_m"] = 2 * OFF_M
    io.write_json(other / "metrics.json", found)
    assert Reader(page_of(lidarflow, other)).row("strict accuracy [%]") == ["100.00"], "one pair"
    text = page_of(lidarflow, other, run)
    assert 'class="best"' not in text and "none is called the best" in text
    assert "1 of 1 pairs pictured" in text


def test_a_run_without_truth(lidarflow, tmp_path):
    scans = [scan for scan, _ in drive()]
    (tmp_path / "scans").mkdir()
    for k, scan in enumerate(scans):
        np.save(tmp_path / "scans" / f"{k:06d}.npy", scan.points)
    run = write_run(tmp_path / "run", open_dataset(tmp_path / "scans"), (0, 1, 2))
    done = lidarflow.complaint("report", run)
    assert "a run without metrics.json" in done and "lidarflow eval" in done
    io.write_json(run / "metrics.json", without_truth(scans, run))
    text = page_of(lidarflow, run)
    read = Reader(text)
    assert "No error maps: the data set has no truth." in text and len(read.of("img")) == 2
    assert "Crispness over time" in text and "by range" not in text and "end-point error, all" not in text


def without_truth(scans, run):
    reports = []
    for scan, following in itertools.pairwise(scans):
        found = flow_files.load_flow(run / "flow" / f"{scan.name}.npz").result()
        aligned = metrics.alignment(scan, following, found, CONFIG.crispness.sigma_m)
        reports.append(pair_reports.report_result(scan, found, 5, aligned, None, "none"))
    return pair_reports.metrics_of(reports, CONFIG)


def test_data_that_are_gone_cost_only_the_error_maps(lidarflow, run, tmp_path):
    source = provenance.read(run)
    gone = replace(source.dataset, folder=tmp_path / "gone")
    provenance.write(run, provenance.RunSource(gone, source.scans))
    text = page_of(lidarflow, run)
    assert f"No error maps, and arrows drawn as if scans were 0.1 s apart: {gone.folder} is not there" in text
    assert len(Reader(text).of("img")) == 2
    provenance.write(run, provenance.RunSource(None, source.scans))
    assert "the run was not made from a data folder" in page_of(lidarflow, run)


def test_metrics_survive_the_way_through_json(made):
    done = evaluation.evaluate_run(made / "run")
    found = json.loads((made / "run" / "metrics.json").read_text())
    pairs = rebuilt(tuple[PairReport, ...], found["pairs"], "pairs")
    for before, after in zip(done.reports, pairs, strict=True):
        assert after.frame == before.frame and after.stats == before.stats
        assert after.scores.accuracy_all == before.scores.accuracy_all
        np.testing.assert_equal(after.scores.by_range[-1].high_m, np.inf)
        np.testing.assert_equal(after.scores.by_range[-1].all.mean, before.scores.by_range[-1].all.mean)
        assert np.isfinite(after.scores.graph_static.mean)


def test_moving_objects_are_listed_those_seen_longest_first(lidarflow, run):
    assert "Moving objects" not in page_of(lidarflow, run)
    size = 4.0, 2.0, 1.5
    io.write_objects(run / "objects.csv", [
        ("000000", 7, 40, 9.0, 12.0, 0.0, *size, 0.0, 8.0, 0.0, 0.0, 8.0),
        ("000000", 9, 10, 30.0, 40.0, 0.0, *size, 0.0, 1.0, 0.0, 0.0, 1.0),
        ("000001", 9, 30, 3.0, 4.0, 0.0, *size, 0.0, 2.0, 0.0, 0.0, 2.0)])
    read = Reader(page_of(lidarflow, run))
    objects = [row for row in read.rows if len(row) == 7 and row[0] in "79"]
    assert objects == [["9", "2", "000000", "1.5", "4.0 × 2.0 × 1.5", "20", "5.0"],
                       ["7", "1", "000000", "8.0", "4.0 × 2.0 × 1.5", "40", "15.0"]]
    (run / "objects.csv").write_text("frame,id\n000000,x\n")
    assert "run/objects.csv: damaged (ValueError" in lidarflow.complaint("report", "run")


@pytest.mark.parametrize(("change", "words"), [
    (lambda found: found.pop("pairs"), "KeyError: 'pairs'"),
    (lambda found: found.update(truth=5), "truth: expected str"),
    (lambda found: found["mean"].update(t_e_m="far"), "mean.t_e_m: expected a number"),
    (lambda found: found["pairs"][1].pop("alignment"), "pairs[1].alignment is missing"),
    (lambda found: found["pairs"][0]["scores"].update(by_range={}), "scores.by_range: expected a list"),
    (lambda found: found["pairs"].reverse(), "pair 0 is of scan 000001, but that of the data is of 000000"),
    (lambda found: found.update(pairs=found["pairs"][:1]), "1 pairs, but source.json names the scans of 2"),
])
def test_damaged_metrics(lidarflow, run, change, words):
    found = json.loads((run / "metrics.json").read_text())
    change(found)
    (run / "metrics.json").write_text(json.dumps(found))
    said = lidarflow.complaint("report", "run")
    assert said.startswith("run/metrics.json: ") and words in said and "run again" in said


def test_what_is_no_run(lidarflow, run, tmp_path):
    assert "nowhere: no such folder; expected a folder that" in lidarflow.complaint("report", "nowhere")
    (tmp_path / "empty").mkdir()
    assert "empty: no metrics.json; expected a folder that" in lidarflow.complaint("report", "run", "empty")
    assert "metrics.json: is a file" in lidarflow.complaint("report", "run/metrics.json")
    assert "ending in .html" in lidarflow.complaint("report", "run", "--out", "page.txt")
    (run / "flow" / "000001.npz").write_bytes(b"PK")
    assert "000001.npz: not an .npz archive" in lidarflow.complaint("report", "run")
    (run / "flow" / "000001.npz").unlink()
    assert "no flow of scan 000001" in lidarflow.complaint("report", "run")
    (run / "metrics.json").write_text("[1")
    assert "run/metrics.json: damaged" in lidarflow.complaint("report", "run")
    (run / "metrics.json").write_text("[1]")
    assert "holds no object" in lidarflow.complaint("report", "run")
    assert not (tmp_path / "report.html").exists() and not (tmp_path / "page.html").exists()


def test_pictured_pairs_are_few_and_evenly_chosen():
    assert reading.evenly_chosen(4, 6) == [0, 1, 2, 3]
    assert reading.evenly_chosen(101, 6) == [0, 20, 40, 60, 80, 100]
    assert reading.evenly_chosen(1, 6) == [0] and reading.evenly_chosen(9, 1) == [4]
    assert [report.shown_per_run(runs) for runs in (1, 2, 3, 12, 50)] == [6, 6, 4, 1, 1]


def test_error_maps_show_the_error_where_it_is():
    pair, result = street()
    points = pair.source.points
    flow = result.flow.copy()
    flow[MOVER] += (0.0, 1.0, 0.0)
    known = np.isfinite(flow).all(axis=1)
    truth = Truth(flow, result.ego_motion, known, result.is_dynamic, np.where(result.is_dynamic, 0, -1))
    png = pictures.error_png(pair.source, result, truth)
    picture = np.asarray(Image.open(memory.BytesIO(png)).convert("RGB")).astype(int)
    wrong = np.abs(picture - pictures.ERROR_COLOURS[-1]).max(axis=2) < 8
    scale = len(picture) / 2 / preview.half_width(points)
    row, column = (round(len(picture) / 2 - metres * scale) for metres in (10, 12))
    assert wrong[row - 10: row + 11, column - 10: column + 11].sum() > 50
    wrong[row - 20: row + 21, column - 20: column + 21] = False
    wrong[: len(picture) // 4, len(picture) // 2:] = False       # the legend
    assert not wrong.any()


def test_colours_of_errors_step_at_the_thresholds():
    steps = np.array([0.0, 0.0199, 0.02, 0.0999, 0.3, 5.0])
    np.testing.assert_array_equal(pictures.error_colours(steps), pictures.ERROR_COLOURS[[0, 0, 1, 2, 4, 4]])
    brightness = pictures.ERROR_COLOURS.sum(axis=1, dtype=int)
    assert (np.diff(brightness) > 0).all() and brightness[0] > pictures.UNKNOWN.sum(dtype=int)


def test_bars_are_as_high_as_their_values():
    svg = plots.bars("<t>", ["a&b", "c"], {"static": [0.5, np.nan], "moving": [1.0, 0.25]})
    assert "&lt;t&gt;" in svg and "a&amp;b" in svg and "<t>" not in svg

    def heights(name):
        found = re.findall(rf'height="([\d.]+)" fill="{plots.COLOURS[name]}"', svg)
        return [float(height) for height in found[1:]]      # the first is in the legend

    (half,), (whole, quarter) = heights("static"), heights("moving")
    assert whole == pytest.approx(2 * half, abs=0.2) and whole == pytest.approx(4 * quarter, abs=0.4)


def test_lines_break_where_values_are_missing():
    svg = plots.lines("t", list("abcd"), {"static": [0.1, 0.2, np.nan, 0.3]}, top=1.0)
    assert svg.count("<polyline") == 2 and svg.count("<circle") == 3
    assert plots.lines("t", [], {"static": []}).count("<circle") == 0
    assert "moving" not in plots.lines("t", ["a"], {"static": [1.0], "moving": [np.nan]})

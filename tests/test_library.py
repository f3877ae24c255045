"""lidarflow as a library: short names, arrays in and out, types, and the examples of CONTRIBUTING."""

import re
import subprocess
import sys
import types
import warnings
import zipfile
from pathlib import Path

import numpy as np
import pytest
import typed_use
from command_line import drive
from shared_data import ROOT

import lidarflow
from lidarflow import datasets, pipeline, rgbd_methods
from lidarflow.config import Config
from lidarflow.methods import METHODS
from lidarflow.rgbd import RgbdEstimator
from lidarflow.rgbd_types import Camera, RgbdFrame
from lidarflow.types import Scan, ScanPair, as_pair, as_scan

FAST = lidarflow.load(overrides=("solver.method=fast",))
CAMERA = Camera.from_field_of_view(16, 12)


def clouds():
    return [scan.points for scan, _ in drive()]


def test_the_package_offers_its_parts():
    assert lidarflow.estimate_flow is pipeline.estimate_flow and lidarflow.Config is Config
    assert {name for name in lidarflow.__all__ if getattr(lidarflow, name) is None} == set()
    assert set(lidarflow.__all__) <= set(dir(lidarflow))
    with pytest.raises(AttributeError, match="no attribute 'estimate_flows'"):
        _ = lidarflow.estimate_flows


def test_the_package_alone_loads_nothing_heavy():
    code = ("import sys, lidarflow\n"
            "print([m for m in ('numpy', 'gtsam', 'open3d', 'numba') if m in sys.modules])\n"
            "from lidarflow import FlowEstimator\nprint('numba' in sys.modules)")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\nTrue\n"


def test_arrays_and_scans_give_the_same_flow():
    source, target = clouds()[:2]
    of_arrays = lidarflow.estimate_flow((source.astype(np.float32), target.astype(np.float32)), FAST)
    pair = ScanPair(Scan(source.astype(np.float32)), Scan(target.astype(np.float32)))
    of_scans = lidarflow.estimate_flow(pair, FAST)
    np.testing.assert_array_equal(of_arrays.flow, of_scans.flow)
    assert of_arrays.flow.shape == source.shape and of_arrays.flow.dtype == np.float64


def test_two_clouds_are_a_pair_however_they_come():
    source, target = clouds()[:2]
    there = [lidarflow.estimate_flow(pair, FAST).flow for pair in (
        (source, target), [Scan(source), target], ScanPair(source, target))]
    np.testing.assert_array_equal(there[0], there[1])
    np.testing.assert_array_equal(there[0], there[2])
    assert as_pair(np.zeros((2, 5, 3))).target.points.shape == (5, 3), "two scans in one array"


@pytest.mark.parametrize("pair, found", [
    (np.zeros((9, 3)), "pair: one array (9, 3)"), (np.zeros((2, 3)), "pair: one array (2, 3)"),
    (Scan(np.zeros((9, 3))), "pair: of type Scan"), (None, "pair: of type NoneType"),
    ((np.zeros((9, 3)),) * 3, "pair: 3 in a tuple"), ([], "pair: 0 in a list")])
def test_a_pair_is_two_scans(pair, found):
    for more in (), (np.zeros((9, 3)),):     # the second scan is no configuration
        with pytest.raises(lidarflow.LidarflowError) as caught:
            lidarflow.estimate_flow(pair, *more)
        assert str(caught.value) == f"{found}; expected two scans, as in estimate_flow((source, target))"


@pytest.mark.parametrize("scans, found", [
    ((np.zeros((9, 4)), np.zeros((9, 3))), "source: an array (9, 4)"),
    ((np.zeros((9, 3)), None), "target: of type NoneType")])
def test_a_pair_says_which_of_its_scans_is_none(scans, found):
    for made in (lambda: ScanPair(*scans), lambda: as_pair(scans)):
        with pytest.raises(lidarflow.LidarflowError, match=re.escape(found)):
            made()


def test_a_stream_of_arrays_is_a_stream_of_scans():
    arrays, scans = lidarflow.FlowEstimator(FAST), lidarflow.FlowEstimator(FAST)
    results = [(arrays.step(scan.points), scans.step(scan)) for scan, _ in drive()]
    assert results[0] == (None, None)
    for of_array, of_scan in results[1:]:
        np.testing.assert_array_equal(of_array.flow, of_scan.flow)
    truth = drive()[1][1]
    error_m = np.linalg.norm(results[2][0].flow - truth.flow, axis=1)
    assert np.median(error_m[~truth.is_dynamic]) < 0.03


NO_POINTS = [
    (np.zeros((5, 4)), "source: an array (5, 4) of float64; expected points (N, 3)"),
    (np.zeros(3), "an array (3,) of float64"),
    (np.array([["a", "b", "c"]]), "an array (1, 3) of <U1"),
    (np.zeros((4, 3), bool), "an array (4, 3) of bool"),
    ([[1, 2], [3, 4]], "an array (2, 2) of int64"),
    ([[1, 2, 3], [4, 5]], "source: a list that is no array"),
    (np.array([[1, 2, 3], [4, 5]], object), "source: an array (2,) of dtype object, as rows of unequal len"),
    (np.zeros((4, 3), object), "an array (4, 3) of dtype object"),
    ([[1, 2, None]], "expected points (N, 3) of numbers, such as float64"),
    (None, "source: of type NoneType; expected points (N, 3)"),
    ("scan0.bin", "source: the path 'scan0.bin'; expected points (N, 3), lidarflow.read_scan reads them"),
    (Path("scan0.bin"), "the path 'scan0.bin'")]


@pytest.mark.parametrize("points, found", NO_POINTS)
def test_no_scan_is_made_of_what_is_no_points(points, found):
    with pytest.raises(lidarflow.LidarflowError) as caught:
        Scan(points, name="source")
    assert found in str(caught.value) and isinstance(caught.value, ValueError)


@pytest.mark.parametrize("points, found", [
    *NO_POINTS,
    (np.zeros((4, 3)), "none of 4 points lies between"),
    (np.empty((0, 3)), "none of 0 points lies between"),
    (np.full((4, 3), np.nan), "none of 4 points lies between")])
def test_arrays_that_are_no_points(points, found):
    with pytest.raises(lidarflow.LidarflowError) as caught:
        lidarflow.estimate_flow((points, clouds()[0]))
    assert found in str(caught.value)


def test_whole_numbers_are_points():
    scan = as_scan(np.array([[1, 2, 3]]), "mine")
    assert scan.points.dtype == np.float64 and scan.name == "mine" and as_scan(scan) is scan
    np.testing.assert_array_equal(Scan([[1, 2, 3]]).points, scan.points)


def test_rows_that_are_masked_or_not_finite_are_nan_rows():
    source, target = clouds()[:2]
    masked = np.ma.masked_array(source.astype(np.float32), mask=False)
    masked[3, 1] = np.ma.masked
    broken = source.astype(np.float32)
    broken[3] = 1.0, np.inf, np.nan
    gap = source.astype(np.float32)
    gap[3] = np.nan
    assert np.isnan(Scan(masked).points).all(axis=1).nonzero()[0].tolist() == [3]
    assert np.isfinite(Scan(np.ma.masked_array(source)).points).all()
    assert np.isinf(broken[3, 1]), "what is given is not written to"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        flows = [lidarflow.estimate_flow((points, target), FAST).flow for points in (masked, broken, gap)]
        lidarflow.estimate_flow((source, broken), FAST)
    np.testing.assert_array_equal(flows[0], flows[2])
    np.testing.assert_array_equal(flows[1], flows[2])
    assert np.isnan(flows[0][3]).all() and np.isfinite(flows[0][2]).all()


def test_masked_whole_numbers_have_gaps_too():
    points = np.ma.masked_array(np.ones((2, 3), np.int32), mask=[[False] * 3, [True, False, False]])
    np.testing.assert_array_equal(Scan(points).points, [[1, 1, 1], [np.nan] * 3])


NO_TIMES = ["x", float("nan"), 1.5, None, True, np.bool_(True), np.datetime64(5, "ns"), 2**63]


@pytest.mark.parametrize("time_ns", NO_TIMES)
def test_times_are_whole_nanoseconds(time_ns):
    image = np.full((2, 2), 0.5)
    for made in (lambda: Scan(np.zeros((1, 3)), time_ns), lambda: RgbdFrame(image, image, time_ns)):
        with pytest.raises(lidarflow.LidarflowError, match=r"time_ns is .* whole nanoseconds.*seconds"):
            made()


def test_times_without_a_sign_may_go_backwards():
    early, late = (Scan(np.zeros((1, 3)), np.uint64(time_ns)) for time_ns in (10**9, 3 * 10**9))
    assert type(early.time_ns) is int
    assert ScanPair(early, late).dt_s == 2.0 and ScanPair(late, early).dt_s == 0.1


def test_a_stream_may_be_in_one_array_that_is_overwritten():
    points = clouds()[0].copy()
    assert Scan(points).points is points, "nothing is copied that need not be"
    scan = as_scan(points)
    points[:] = 0.0
    np.testing.assert_array_equal(scan.points, clouds()[0])


def test_after_a_bad_scan_the_stream_goes_on():
    estimator = lidarflow.FlowEstimator(FAST)
    estimator.step(clouds()[0])
    with pytest.raises(lidarflow.LidarflowError):
        estimator.step(np.zeros((4, 2)))
    assert estimator.step(clouds()[1]).flow.shape == clouds()[0].shape


@pytest.mark.parametrize("wrong, found", [
    ("my.toml", "'my.toml'; expected a {0}, such as lidarflow.load('my.toml'{1})"),
    (Path("my.toml"), "'my.toml'; expected a {0}, such as lidarflow.load('my.toml'{1})"),
    ({}, "of type dict; expected a {0}, such as lidarflow.load(file{1})")])
@pytest.mark.parametrize("start, kind, more", [
    (lambda config: lidarflow.estimate_flow((np.zeros((9, 3)),) * 2, config), "Config", ""),
    (lidarflow.FlowEstimator, "Config", ""),
    (METHODS["icp"].along, "Config", ""),
    (lambda config: RgbdEstimator(CAMERA, config), "RgbdConfig", ", (), RgbdConfig"),
    (lambda config: rgbd_methods.Open3dOdometry(CAMERA, config), "RgbdConfig", ", (), RgbdConfig")])
def test_settings_are_no_file(wrong, found, start, kind, more):
    with pytest.raises(lidarflow.LidarflowError) as caught:
        start(wrong)
    assert str(caught.value) == "settings: " + found.format(kind, more)


def test_overrides_are_several():
    with pytest.raises(lidarflow.LidarflowError, match=r"expected several, as in \('solver.method=fast',\)"):
        lidarflow.load(overrides="solver.method=fast")


# Types.

def test_the_program_that_is_type_checked_runs(kitti, scans):
    source, target = (points.astype(np.float32) for points in clouds()[:2])
    assert typed_use.of_two_files(scans[0], scans[1]).shape == source.shape
    assert typed_use.of_two_arrays(source, target).flow.shape == source.shape
    speeds = typed_use.along(kitti)
    assert speeds and min(speeds) > 0.3
    assert typed_use.first_to_last(kitti).flow.shape == source.shape


@pytest.mark.slow
def test_types_of_the_public_names_are_right(tmp_path):
    pytest.importorskip("mypy")
    words = [sys.executable, "-m", "mypy", "--cache-dir", str(tmp_path)]
    done = subprocess.run(words, capture_output=True, text=True, check=False, cwd=ROOT)
    assert done.returncode == 0, done.stdout


def test_the_wheel_says_that_it_is_typed(tmp_path):
    pytest.importorskip("hatchling")
    words = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(tmp_path)]
    subprocess.run(words, capture_output=True, check=True, cwd=ROOT)
    wheel, = tmp_path.glob("*.whl")
    names = zipfile.ZipFile(wheel).namelist()
    assert "lidarflow/py.typed" in names and "lidarflow/export/ply.py" in names
    assert not [name for name in names if name.startswith("tests")]


# CONTRIBUTING.

def test_a_loader_as_contributing_shows_it(tmp_path, monkeypatch):
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    loader, line = re.findall(r"```python\n(.*?)```", text, re.DOTALL)[:2]
    written = [row for row in loader.splitlines() if row.strip() and not row.startswith(("import", "from"))]
    assert len(written) <= 10, "in ten lines"
    name, place = re.search(r'"(\w+)": "([\w.]+):MyDrive"', line).groups()
    module = types.ModuleType(place)
    exec(compile(loader, "CONTRIBUTING.md", "exec"), module.__dict__)
    monkeypatch.setitem(sys.modules, place, module)
    monkeypatch.setitem(datasets.LOADERS, name, f"{place}:MyDrive")
    for k, points in enumerate(clouds()):
        points.astype(np.float32).tofile(tmp_path / f"{k}.xyz32")
    data = datasets.open_dataset(tmp_path, name)
    assert (data.loader, len(data)) == (name, 3) and data.source.loader == name
    np.testing.assert_array_equal(data.scan(2).points, clouds()[2].astype(np.float32))

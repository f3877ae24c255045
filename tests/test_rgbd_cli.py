"""`lidarflow rgbd`: what it takes, what it writes, what it says, and how it refuses what it cannot use."""

import json
import os
import subprocess
import sys
import zipfile

import numpy as np
import pytest
from command_line import rests
from PIL import Image
from rgbd_worlds import FRAMES, QVGA, copied, frames

from lidarflow import demo, pose, rgbd, rgbd_io, rgbd_methods, settings, synthetic
from lidarflow.datasets.rgbd_folders import open_rgbd
from lidarflow.datasets.rgbd_images import read_frame
from lidarflow.rgbd_config import RgbdConfig
from lidarflow.rgbd_types import RgbdPair

pytestmark = pytest.mark.usefixtures("in_tmp_path")

CONTRACT = {"flow": ("float32", (240, 320, 3)), "valid": ("bool", (240, 320)), "label": ("int32", (240, 320)),
            "points": ("float32", (240, 320, 3)), "is_dynamic": ("bool", (240, 320)),
            "color": ("uint8", (240, 320, 3)), "odometry": ("float64", (4, 4)), "camera": ("float64", (6,))}
RUN_FILES = {"config.toml", "flow", "metrics.json", "poses_tum.txt", "preview.png", "recording.rrd",
             "source.json", "timing.json"}
PROGRAM = (sys.executable, "-c", "from lidarflow.cli import main; main()")
SAME = ("config.toml", "metrics.json", "poses_tum.txt", "preview.png")
HEAVY = ("gtsam", "open3d", "numba", "rerun", "scipy", "PIL", "numpy")


@pytest.fixture(scope="session")
def folder(tmp_path_factory):
    """Four rendered frames as a TUM folder."""
    place = tmp_path_factory.mktemp("rgbd") / "room"
    synthetic.write_tum(place, frames(), QVGA)
    return place


@pytest.fixture
def images(folder, tmp_path):
    """Copies of the first two frames' files: color0.png depth0.png color1.png depth1.png."""
    found = []
    for k, stamp in enumerate(("0.000000", "0.033333")):
        for kind, name in (("rgb", "color"), ("depth", "depth")):
            file = tmp_path / f"{name}{k}.png"
            file.write_bytes((folder / kind / f"{stamp}.png").read_bytes())
            found.append(file)
    return found


@pytest.fixture(scope="session")
def finished(folder, tmp_path_factory):
    """A run folder, and what the run said, of a process of its own."""
    out = tmp_path_factory.mktemp("results") / "a"
    done = subprocess.run([*PROGRAM, "rgbd", "run", str(folder), "--out", str(out)], capture_output=True,
                          text=True, check=False, env=os.environ | {"COLUMNS": "80"})
    assert (done.returncode, done.stderr) == (0, "")
    return out, done.stdout


def save(path, image):
    Image.fromarray(image).save(path)
    return path


def expected(images):
    """The result of the pair in four files."""
    source, target = (read_frame(*images[k:k + 2], 5000.0) for k in (0, 2))
    return rgbd.estimate_flow(RgbdPair(source, target, QVGA))


# What answers at once.

def test_help_loads_nothing_heavy_and_fits_80_columns(lidarflow):
    code = ("import sys\nfrom lidarflow import cli\nsys.argv = ['lidarflow', 'rgbd', '--help']\n"
            "try:\n    cli.main()\nfinally:\n"
            f"    print('LOADED', [m for m in {HEAVY} if m in sys.modules])")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.endswith("LOADED []\n")
    for words in ((), ("pair",), ("run",)):
        out = lidarflow.ok("rgbd", *words, "--help")
        assert all(len(line) <= 80 for line in out.splitlines())
    assert "..." not in lidarflow.ok("rgbd", "--help").split("Commands:")[1]


def test_config_shows_every_setting(lidarflow):
    words = lidarflow.ok("rgbd", "config").split()
    for name, _, _, effect in settings.describe(RgbdConfig):
        assert name in words and effect.split()[0] in words


def test_usage_errors_exit_with_2(lidarflow):
    for words in ("pear", "pair a b c", "pair a b c d", "run x", "run x --out o -n y"):
        code, _, err = lidarflow("rgbd", *words.split())
        assert code == 2 and "Traceback" not in err


# pair

def test_pair_writes_what_the_method_finds(lidarflow, images):
    out = lidarflow.ok("rgbd", "pair", *images, "--out", "deep/flow.npz")
    assert "nominal PrimeSense" in out and "odometry" in out and "moving" in out
    result = expected(images)
    with np.load("deep/flow.npz") as archive:
        for name, (dtype, shape) in CONTRACT.items():
            assert archive[name].dtype == dtype and archive[name].shape == shape, name
        for name, shape in (("cluster_motions", (4, 4)), ("centres", (3,))):
            assert archive[name].shape == (len(archive["b"]), *shape)
        for name in ("flow", "valid", "label", "points", "is_dynamic", "b", "cluster_motions", "odometry"):
            np.testing.assert_array_equal(archive[name], getattr(result, name))
        np.testing.assert_array_equal(archive["color"], np.asarray(Image.open(images[0])))
        assert json.loads(str(archive["config"]))["clusters"]["count"] == RgbdConfig().clusters.count
        stats = json.loads(str(archive["stats"]))
    assert stats["method"] == "ours"
    assert stats["residuals"]["after"]["photometric"] < stats["residuals"]["before"]["photometric"]
    assert os.listdir("deep") == ["flow.npz"]


def test_pair_writes_the_same_bytes_again(lidarflow, images):
    for name in ("a", "b"):
        lidarflow.ok("rgbd", "pair", *images, "--out", f"{name}.npz", "--picture", f"{name}.png")
    for suffix in ("npz", "png"):
        with open(f"a.{suffix}", "rb") as first, open(f"b.{suffix}", "rb") as second:
            assert first.read() == second.read()


def test_the_camera_and_the_depth_scale_are_the_users(lidarflow, images, tmp_path):
    camera = "width = 320\nheight = 240\nfx = 300.0\nfy = 310.0\ncx = 150.0\ncy = 125.0\n"
    (tmp_path / "camera.toml").write_text(camera)
    for name, camera in (("a", ("--camera", "camera.toml")), ("b", ("--intrinsics", 300, 310, 150, 125))):
        lidarflow.ok("rgbd", "pair", *images, "--out", f"{name}.npz", *camera, "--depth-scale", 1000)
    first, second = (rgbd_io.load_flow(tmp_path / name).result for name in ("a.npz", "b.npz"))
    np.testing.assert_array_equal(first.points, second.points)
    assert (first.camera.fx, first.camera.fy, first.camera.cx, first.camera.cy) == (300, 310, 150, 125)
    depth = np.asarray(Image.open(images[1]))
    np.testing.assert_allclose(first.points[..., 2], depth / 1000.0, rtol=1e-6)
    x = (np.arange(320) - 150) / 300 * first.points[..., 2]
    np.testing.assert_allclose(first.points[..., 0], x, rtol=1e-5)


def test_settings_reach_the_method_and_are_stored(lidarflow, images, tmp_path):
    (tmp_path / "few.toml").write_text("[clusters]\ncount = 6\n")
    lidarflow.ok("rgbd", "pair", *images, "--out", "f.npz", "--config", "few.toml",
                 "--set", "images.width=160")
    found = rgbd_io.load_flow(tmp_path / "f.npz")
    assert len(found.result.b) <= 6 and found.result.flow.shape == (120, 160, 3)
    assert found.config["clusters"]["count"] == 6 and found.config["images"]["width"] == 160


def test_pair_by_open3d(lidarflow, images, tmp_path):
    lidarflow.ok("rgbd", "pair", *images, "--out", "f.npz", "--method", "open3d")
    found = rgbd_io.load_flow(tmp_path / "f.npz")
    assert found.stats["method"] == "open3d" and not found.result.is_dynamic.any()
    assert pose.translation_distance(found.result.odometry, frames()[0][1].odometry) < 0.03


def test_view_makes_a_recording_of_a_flow_file(lidarflow, images, tmp_path):
    lidarflow.ok("rgbd", "pair", *images, "--out", "f.npz", "--recording", "pair.rrd")
    lidarflow.ok("view", "f.npz", "--save", "file.rrd")
    for name in ("pair.rrd", "file.rrd"):
        done = subprocess.run([sys.executable, "-m", "rerun", "rrd", "verify", name], capture_output=True)
        assert done.returncode == 0
    assert "needs a display" in lidarflow.complaint("view", "f.npz")
    said = lidarflow.complaint("view", "f.npz", "--target", "color1.png", "--save", "x.rrd")
    assert "need no target" in said
    assert rests(tmp_path) == []


# run

def test_a_run_folder(finished, folder):
    out, said = finished
    assert {entry.name for entry in out.iterdir()} == RUN_FILES
    stamps = ["0.000000", "0.033333", "0.066667"]
    assert sorted(file.name for file in (out / "flow").iterdir()) == [f"{stamp}.npz" for stamp in stamps]
    assert os.readlink(out.parent / "latest") == "a" and rests(out) == []
    assert all(len(line) <= 80 for line in said.split("results")[0].splitlines()[5:])
    for text in ("4 frames", "camera.toml", "pixel/5000", "EPE", "IoU", "the given poses, 3 steps"):
        assert text in said
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["method"] == "ours" and metrics["drift"]["frames"] == 3 and len(metrics["pairs"]) == 3
    assert metrics["mean"]["drift_m"] < 0.005 and metrics["mean"]["drift_deg"] < 0.2
    assert metrics["mean"]["iou"] > 0.7 and metrics["mean"]["depth_share"] > 0.8
    assert metrics["drift"]["per_second_m"] is None
    assert metrics["mean"]["photometric"] < 0.5 * metrics["mean"]["photometric_before"]
    timing = json.loads((out / "timing.json").read_text())
    assert set(timing) == set(stamps) and all("scores and output" in stages for stages in timing.values())


def test_a_run_carries_its_state_along_and_chains_its_poses(finished, folder):
    out, _ = finished
    found = open_rgbd(folder)
    estimator, steps = rgbd.RgbdEstimator(found.camera), []
    for k in range(FRAMES):
        result = estimator.step(found.frame(k))
        if result is not None:
            steps.append(result.odometry)
            stored = rgbd_io.load_flow(out / "flow" / f"{found.frame(k - 1).name}.npz").result
            np.testing.assert_array_equal(stored.flow, result.flow)
            np.testing.assert_array_equal(stored.b, result.b)
    rows = np.loadtxt(out / "poses_tum.txt")
    np.testing.assert_allclose(rows[:, 0], [0.0, 0.033333, 0.066667, 0.1], atol=1e-6)
    poses = pose.from_translation_quaternion(rows[:, 1:])
    np.testing.assert_allclose(poses, pose.trajectory(steps), atol=1e-9)


def test_a_run_again_gives_the_same_bytes(lidarflow, finished, folder, tmp_path):
    out, _ = finished
    assert "replacing" not in lidarflow.ok("rgbd", "run", folder, "--out", "b", "--no-record")
    for name in (*SAME, "flow/0.000000.npz", "flow/0.066667.npz"):
        assert (out / name).read_bytes() == (tmp_path / "b" / name).read_bytes(), name
    assert not (tmp_path / "b" / "recording.rrd").exists()
    assert "replacing  b: holds an earlier run" in lidarflow.ok(
        "rgbd", "run", folder, "-n", 2, "--out", "b", "--no-record")


def test_part_of_a_sequence_by_another_method(lidarflow, folder, tmp_path):
    lidarflow.ok("rgbd", "run", folder, "--out", "part", "-j", 1, "-n", 2, "--method", "open3d")
    assert os.listdir(tmp_path / "part" / "flow") == ["0.033333.npz"]
    assert len(np.loadtxt(tmp_path / "part" / "poses_tum.txt")) == 2
    assert json.loads((tmp_path / "part" / "metrics.json").read_text())["method"] == "open3d"
    lidarflow.ok("view", "part", "--save", "copy.rrd")
    for command in ("report", "eval"):
        assert "part: is a run of RGB-D images; expected one of LiDAR" in lidarflow.complaint(command, "part")
    assert (tmp_path / "copy.rrd").read_bytes() == (tmp_path / "part" / "recording.rrd").read_bytes()


def test_the_demo_runs_twice_into_one_folder(lidarflow, tmp_path, monkeypatch):
    monkeypatch.setattr(demo, "FRAMES", 3)
    for _ in range(2):
        out = lidarflow.ok("rgbd", "demo", "--out", "demo")
        assert "3 frames with truth" in out and "IoU" in out and "lidarflow view demo" in out
        assert set(os.listdir("demo")) == {"data", "run", "latest"}
    assert sorted(os.listdir("demo/run/flow")) == ["0.000000.npz", "0.033333.npz"] and not rests(tmp_path)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").touch()
    assert "thesis.txt" in lidarflow.complaint("rgbd", "demo", "--out", "mine")


# What cannot be used: one line, exit code 1, nothing written.

def test_pairs_that_cannot_be_used(lidarflow, images, tmp_path):
    color0, depth0, color1, depth1 = images
    zero = save(tmp_path / "zero.png", np.zeros((240, 320), np.uint16))
    speck = save(tmp_path / "speck.png", np.pad(np.full((1, 1), 5000, np.uint16), ((120, 119), (160, 159))))
    shallow = save(tmp_path / "shallow.png", np.full((240, 320), 9, np.uint8))
    small = save(tmp_path / "small.png", np.full((120, 160), 5000, np.uint16))
    small_color = save(tmp_path / "small_color.png", np.full((120, 160, 3), 90, np.uint8))
    cut = tmp_path / "cut.png"
    cut.write_bytes(depth1.read_bytes()[:9000])
    before = sorted(os.listdir(tmp_path))
    for words, found in (
        ((color0, zero, color1, depth1), "zero.png: no pixel has depth"),
        ((color0, depth0, color1, zero), "zero.png: no pixel has depth"),
        ((color0, depth0, color1, speck), "odometry: 0% of the first frame's depth is seen again"),
        ((color0, shallow, color1, depth1), "shallow.png: an 8-bit image"),
        ((depth0, color0, depth1, color1), "depth0.png: a 16-bit image of one channel"),
        ((color0, color1, depth0, depth1), "color1.png: an 8-bit image of mode RGB; expected 16-bit depth"),
        ((color0, small, color1, depth1), "small.png: 160x120 pixels, but"),
        ((color0, depth0, small_color, small), "small_color.png: 160x120 pixels, but"),
        ((color0, depth0, color1, cut), "cut.png: damaged image"),
        ((color0, depth0, color1, "none.png"), "none.png: no such file"),
        ((*images, "--depth-scale", "0"), "--depth-scale 0: expected a positive number"),
        ((*images, "--method", "icp"), "--method icp: unknown; expected one of ours, open3d"),
        ((*images, "--camera", "none.toml"), "none.toml: no such camera file"),
        ((*images, "--camera", "none.toml", "--intrinsics", 1, 1, 1, 1), "both are given"),
        ((*images, "--intrinsics", -1, 1, 1, 1), "positive focal lengths"),
        ((*images, "--set", "clusters.cuont=3"), "did you mean 'count'"),
        ((*images, "--set", "clusters.count=0"), "expected 1 .. 200"),
        ((*images, "--picture", "p.jpg"), "--picture p.jpg: expected a file name ending in .png"),
        ((*images, "--visualize"), "needs a display"),
    ):
        assert found in lidarflow.complaint("rgbd", "pair", *words, "--out", "flow.npz"), found
    said = lidarflow.complaint("rgbd", "pair", *images, "--out", "f.npz", "--picture", color0)
    assert "is the input itself" in said
    assert "ending in .npz" in lidarflow.complaint("rgbd", "pair", *images, "--out", "flow.png")
    assert sorted(os.listdir(tmp_path)) == before


def test_sequences_that_cannot_be_used(lidarflow, folder, tmp_path):
    one, apart = copied(folder, tmp_path / "one"), copied(folder, tmp_path / "apart")
    (one / "rgb.txt").write_text("0.0 rgb/0.000000.png\n")
    (apart / "depth.txt").write_text("9.0 depth/0.000000.png\n9.1 depth/0.033333.png\n")
    (tmp_path / "empty").mkdir()
    for words, found in (
        (("one",), "1 of 1 frames selected; flow needs at least two, see --n-frames"),
        ((folder, "-n", 1), "1 of 4 frames selected"), ((folder, "-j", 3), "1 of 4"),
        ((folder, "-j", -1), "--jump -1"), ((folder, "-n", -2), "--n-frames -2"),
        (("apart",), "within 20 ms"), (("empty",), "expected rgb.txt"), (("nowhere",), "no such folder"),
        ((folder, "--method", "x"), "--method x"), ((folder, "--depth-scale", -1), "--depth-scale -1"),
        ((folder, "--intrinsics", 0, 1, 1, 1), "--intrinsics")):
        assert found in lidarflow.complaint("rgbd", "run", *words, "--out", "out"), found
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("bad", range(3))
def test_a_damaged_frame_keeps_what_was_done_before(lidarflow, folder, tmp_path, bad):
    place = copied(folder, tmp_path / "bad")
    (place / "depth").unlink()
    (place / "depth").mkdir()
    for k, file in enumerate(sorted((folder / "depth").iterdir())):
        content = file.read_bytes()
        (place / "depth" / file.name).write_bytes(content[:5000] if k == bad else content)
    said = lidarflow.complaint("rgbd", "run", "bad", "--out", "out")
    assert "damaged image" in said and f"(frames {max(bad - 1, 0)} and {max(bad, 1)} of tum bad)" in said
    if bad < 2:
        assert not (tmp_path / "out").exists()
    else:
        assert "the flow of 1 before is kept in out/flow" in said
        assert sorted(os.listdir(tmp_path / "out")) == [".resume", "config.toml", "flow", "source.json"]
        assert os.listdir(tmp_path / "out" / "flow") == ["0.000000.npz"]


# Flow files

@pytest.fixture(scope="session")
def stored(finished):
    return finished[0] / "flow" / "0.033333.npz"


def changed(stored, path, **arrays):
    """A copy of a flow file with other arrays; None leaves one out."""
    with np.load(stored) as archive:
        content = {name: archive[name] for name in archive.files} | arrays
    np.savez(path, **{name: array for name, array in content.items() if array is not None})
    return path


def test_a_flow_file_reads_back(stored):
    found = rgbd_io.load_flow(stored)
    assert rgbd_io.is_rgbd_flow(stored) and found.stats["method"] in rgbd_methods.METHODS
    assert found.config == settings.to_dict(RgbdConfig()) and found.color.shape == (240, 320, 3)
    moved = found.result.odometry_flow()
    still = found.result.valid & (np.nan_to_num(found.result.b_image, nan=1.0) == 0)
    assert np.median(np.linalg.norm((found.result.flow - moved)[still], axis=-1)) < 1e-3


def test_damaged_flow_files_are_refused(lidarflow, stored, tmp_path):
    with np.load(stored) as archive:
        flow, b, label = archive["flow"], archive["b"], archive["label"]
    for name, arrays, found in (
        ("lacks", {"odometry": None}, "lacks odometry"),
        ("flat", {"flow": flow.reshape(-1, 3)}, "'flow' is"),
        ("kind", {"valid": label}, "'valid' is"), ("few", {"b": b[:-1]}, "'centres' is"),
        ("label", {"label": label + 500}, "RgbdResult.label"),
        ("pose", {"odometry": np.ones((4, 4))}, "rigid"),
        ("motion", {"cluster_motions": np.ones((len(b), 4, 4))}, "cluster motions are not rigid"),
        ("camera", {"camera": np.array([np.inf, 1, 1, 1, 0, 0])}, "damaged flow file"),
        ("size", {"camera": np.array([16.0, 12, 1, 1, 0, 0])}, "RgbdResult.valid"),
        ("json", {"stats": np.array("{")}, "damaged flow file"),
        ("list", {"stats": np.array("[]")}, "no tables")):
        file = changed(stored, tmp_path / f"{name}.npz", **arrays)
        assert found in lidarflow.complaint("view", file, "--save", "x.rrd"), name
    content = stored.read_bytes()
    for size in (0, 100, len(content) // 2, len(content) - 10):
        (tmp_path / "cut.npz").write_bytes(content[:size])
        assert "cut.npz" in lidarflow.complaint("view", "cut.npz", "--save", "x.rrd")
    assert not (tmp_path / "x.rrd").exists()


def test_other_files_are_no_rgbd_flow(tmp_path):
    (tmp_path / "text.npz").write_text("no archive")
    with zipfile.ZipFile(tmp_path / "other.npz", "w") as archive:
        archive.writestr("flow.npy", b"")
    for name in ("text.npz", "other.npz", "none.npz"):
        assert not rgbd_io.is_rgbd_flow(tmp_path / name)

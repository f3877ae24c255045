"""RGB-D runs that are killed or meet damaged frames, and go on: as test_resume.py for scans."""

import json
import os

import numpy as np
import pytest
from killed import contents, program, was_killed
from PIL import Image
from rgbd_worlds import QVGA, frames

from lidarflow import io, pose, rgbd_io, rgbd_methods, rgbd_metrics, synthetic
from lidarflow.datasets.rgbd_folders import open_rgbd
from lidarflow.errors import DataError
from lidarflow.rgbd_checkpoints import RgbdCheckpoints
from lidarflow.rgbd_config import RgbdConfig
from lidarflow.rgbd_runner import process
from lidarflow.runner import Going, Viewing
from lidarflow.stepping import Walk, steps

QUIET = Viewing(record=False)
FRAMES = 5
NAMES = ("0.000000", "0.033333", "0.066667", "0.100000", "0.133333")


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    """Five rendered frames as a TUM folder."""
    folder = tmp_path_factory.mktemp("rgbd") / "room"
    synthetic.write_tum(folder, frames(count=FRAMES), QVGA)
    return folder


@pytest.fixture(scope="module")
def unbroken(room, tmp_path_factory):
    """The bytes of a run over the room that nothing disturbed."""
    out = tmp_path_factory.mktemp("unbroken") / "run"
    run(room, out)
    assert not (out / io.RESUME_FOLDER).exists()
    return contents(out)


def run(data, out, method="ours", going=None, on_pair=lambda report: None, chosen=range(FRAMES)):
    return process(open_rgbd(data), list(chosen), method, RgbdConfig(), out, QUIET, on_pair, going)


def copy_of(room, place, damaged=()):
    """A copy of the folder with the depth of some frames cut off."""
    for file in room.rglob("*"):
        if file.is_file():
            content = file.read_bytes()
            is_damaged = file.parent.name == "depth" and file.stem in [NAMES[k] for k in damaged]
            target = place / file.relative_to(room)
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(content[:5000] if is_damaged else content)
    return place


def walk(data, method="ours"):
    folder = open_rgbd(data)
    return Walk.of_frames(folder, rgbd_methods.estimator(method, folder.camera, RgbdConfig()))


# Killed at a moment that is chosen.

@pytest.mark.parametrize("place, number, how", [
    ("os.replace", 1, "before"),                      # before the settings are there
    ("lidarflow.io.archive", 2, "before"),            # first flow file there, no checkpoint
    ("lidarflow.io.archive", 5, "after"),             # third flow file about to be written
    ("os.replace", 6, "before"),                      # second checkpoint written aside
    ("lidarflow.io.write_poses_tum", 1, "before"),    # all pairs done, nothing put together
    ("lidarflow.io.write_json", 3, "after"),          # metrics there, no times
])
def test_a_killed_run_resumes_to_the_same_bytes(room, unbroken, tmp_path, place, number, how):
    out = tmp_path / "run"
    words = ("rgbd", "run", room, "--out", out, "--no-record", "--resume")
    assert was_killed(program(words, place, number, how))
    done = program(words)
    assert done.returncode == 0, done.stderr
    assert contents(out) == unbroken
    assert not list(tmp_path.rglob(".*.part")) and not (out / io.RESUME_FOLDER).exists()


@pytest.mark.parametrize("method", rgbd_methods.METHODS)
def test_every_method_goes_on_as_if_nothing_had_happened(room, unbroken, tmp_path, method):
    def stop(report):
        if report.frame == NAMES[2]:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(room, tmp_path / "cut", method, on_pair=stop)
    before, kept = contents(tmp_path / "cut" / "flow"), RgbdCheckpoints(tmp_path / "cut")
    assert sorted(kept.found()) == [0, 1, 2]
    found = list(steps(walk(room, method), list(range(FRAMES)), kept))
    assert [step.restored for step in found] == [True, True, True, False]
    run(room, tmp_path / "cut", method, Going(resume=True))
    after = contents(tmp_path / "cut" / "flow")
    assert len(before) == 3 and {name: after[name] for name in before} == before and len(after) == 4
    if method == "ours":
        assert contents(tmp_path / "cut") == unbroken
    else:     # Open3D adds up in another order every time
        run(room, tmp_path / "whole", method)
        for name in after:
            cut, whole = (rgbd_io.load_flow(tmp_path / place / "flow" / name).result
                          for place in ("cut", "whole"))
            np.testing.assert_allclose(cut.odometry, whole.odometry, atol=1e-9)


def test_a_resumed_run_records_all_pairs(room, tmp_path, lidarflow):
    out = tmp_path / "run"
    assert was_killed(program(("rgbd", "run", room, "--out", out), "lidarflow.rgbd_io.save_flow", 3))
    lidarflow.ok("rgbd", "run", room, "--out", out, "--resume")
    lidarflow.ok("rgbd", "run", room, "--out", tmp_path / "whole")
    sizes = [(folder / "recording.rrd").stat().st_size for folder in (out, tmp_path / "whole")]
    assert abs(sizes[0] - sizes[1]) < 0.02 * sizes[1]


# What may be resumed.

def test_another_run_is_not_resumed(room, tmp_path, lidarflow):
    out, other = tmp_path / "run", copy_of(room, tmp_path / "other")
    assert was_killed(program(("rgbd", "run", room, "--out", out), "lidarflow.rgbd_io.save_flow", 3))
    before = contents(out)
    for words, found in (
            ((room, "--set", "clusters.count=20"), "with clusters.count = 64, not 20"),
            ((room, "--method", "open3d"), "(Method: ours), not (Method: open3d)"),
            ((room, "--depth-scale", 1000), "depth scale 5000"),
            ((room, "--intrinsics", 300, 300, 160, 120), "not from"), ((other,), f"from {room} (RGB-D"),
            ((room, "-n", 3), "from scans 0 to 4, not 0 to 2")):
        said = lidarflow.complaint("rgbd", "run", *words, "--out", out, "--resume")
        assert found in said and "--resume" in said
    assert contents(out) == before


def test_a_run_of_scans_is_not_resumed_with_images(room, kitti, tmp_path, lidarflow):
    out = tmp_path / "run"
    lidarflow.ok("run", kitti, "--out", out, "--method", "zero", "--no-record")
    assert "not from" in lidarflow.complaint("rgbd", "run", room, "--out", out, "--resume")


@pytest.mark.parametrize("kind", ["rgb", "depth"])
def test_images_that_changed_are_noticed(room, tmp_path, lidarflow, kind):
    data, out = copy_of(room, tmp_path / "data"), tmp_path / "run"
    assert was_killed(program(("rgbd", "run", data, "--out", out), "lidarflow.rgbd_io.save_flow", 3))
    (data / kind / f"{NAMES[0]}.png").write_bytes((data / kind / f"{NAMES[1]}.png").read_bytes())
    said = lidarflow.complaint("rgbd", "run", data, "--out", out, "--resume", "--skip-bad")
    assert "the data changed" in said


def test_a_complete_run_has_nothing_left_to_do(room, tmp_path, lidarflow):
    out = tmp_path / "run"
    words = ("rgbd", "run", room, "--out", out, "-n", 2, "--no-record", "--resume")
    lidarflow.ok(*words)      # nothing there yet: begins anew
    before = {file: file.stat().st_mtime_ns for file in out.rglob("*")}
    assert "nothing is left to do" in lidarflow.ok(*words)
    assert {file: file.stat().st_mtime_ns for file in out.rglob("*")} == before


def test_a_complete_run_that_lost_a_flow_file_is_made_whole(room, tmp_path, lidarflow):
    out = tmp_path / "run"
    words = ("rgbd", "run", room, "--out", out, "-n", 2, "--no-record", "--resume")
    lidarflow.ok(*words)
    whole, file = contents(out), next((out / "flow").iterdir())
    file.write_bytes(file.read_bytes()[:-30])
    assert f"damaged    {out}: flow/{file.name} is missing or cut off" in lidarflow.ok(*words)
    assert contents(out) == whole and "nothing is left to do" in lidarflow.ok(*words)


def test_other_commands_say_that_it_is_a_run_of_images(room, tmp_path, lidarflow):
    out = tmp_path / "run"
    lidarflow.ok("rgbd", "run", room, "--out", out, "-n", 2, "--no-record")
    for words in (("eval", out), ("export", out, "--format", "av2-v1")):
        assert "is a run of RGB-D images" in lidarflow.complaint(*words)


# Checkpoints.

@pytest.mark.parametrize("method", rgbd_methods.METHODS)
def test_a_checkpoint_comes_back_to_the_last_bit(room, tmp_path, method):
    kept = RgbdCheckpoints(tmp_path)
    for step in steps(walk(room, method), [0, 1, 2]):
        kept.save(step.index, step.pair, step.result, step.stretch)
        result, _ = kept.load(step.index, step.pair)
        for name in ("flow", "points", "valid", "label", "b", "cluster_motions", "odometry", "is_dynamic",
                     "centres"):
            was, now = getattr(step.result, name), getattr(result, name)
            assert was.dtype == now.dtype
            np.testing.assert_array_equal(was, now)
        assert (result.camera, result.seconds) == (step.result.camera, step.result.seconds)


def test_a_damaged_checkpoint_is_named(room, tmp_path):
    kept = RgbdCheckpoints(tmp_path)
    step = next(steps(walk(room, "open3d"), [0, 1]))
    kept.save(0, step.pair, step.result, step.stretch)
    file, = kept.folder.iterdir()
    content = file.read_bytes()
    with np.load(file) as archive:
        arrays = dict(archive)
    np.savez(tmp_path / "other.npz", **arrays | {"label": arrays["label"] + 500})
    for damaged in (content[:-30], (tmp_path / "other.npz").read_bytes()):
        file.write_bytes(damaged)
        with pytest.raises(DataError, match=file.name):
            kept.load(0, step.pair)


# Damaged frames.

def test_a_damaged_frame_stops_the_run_and_everything_before_is_kept(room, tmp_path, lidarflow, unbroken):
    data, out = copy_of(room, tmp_path / "data", damaged=(2,)), tmp_path / "run"
    said = lidarflow.complaint("rgbd", "run", data, "--out", out, "--no-record")
    assert f"{NAMES[2]}.png" in said and "flow of 1 before is kept" in said and "--skip-bad" in said
    assert (out / "flow" / f"{NAMES[0]}.npz").read_bytes() == unbroken[f"flow/{NAMES[0]}.npz"]
    copy_of(room, data)       # the frame is mended
    lidarflow.ok("rgbd", "run", data, "--out", out, "--no-record", "--resume")
    mended = contents(out)
    assert {name: mended[name] for name in mended if name != "source.json"} == {
        name: unbroken[name] for name in unbroken if name != "source.json"}


@pytest.mark.parametrize("resumed", [False, True])
def test_a_damaged_frame_is_skipped_and_counted(room, tmp_path, lidarflow, resumed):
    data, out = copy_of(room, tmp_path / "data", damaged=(2,)), tmp_path / "run"
    if resumed:
        lidarflow.complaint("rgbd", "run", data, "--out", out, "--no-record")
    told = lidarflow.ok("rgbd", "run", data, "--out", out, "--skip-bad", *(["--resume"] if resumed else ()))
    assert "skipped    frame 2: " in told and "skipped    1 of 5 frames; 2 pairs are left" in told
    assert sorted(os.listdir(out / "flow")) == [f"{NAMES[0]}.npz", f"{NAMES[3]}.npz"]
    scored = json.loads((out / "metrics.json").read_text())
    assert [frame["scan"] for frame in scored["skipped"]] == [2] and len(scored["pairs"]) == 2
    assert scored["drift"]["frames"] == 2 and scored["drift"]["per_frame_m"] < 0.005
    assert json.loads((out / "source.json").read_text())["skipped"] == [2]
    rows = np.loadtxt(out / "poses_tum.txt")
    np.testing.assert_allclose(rows[:, 0], [float(NAMES[k]) for k in (0, 1, 3, 4)], atol=1e-6)
    poses = pose.from_translation_quaternion(rows[:, 1:])
    # On as before, for a time that is as long as two steps but for the rounding of names to microseconds.
    np.testing.assert_allclose(poses[1] @ poses[1] @ poses[1], poses[2], atol=1e-5)
    lidarflow.ok("export", out, "--format", "kitti", "--out", tmp_path / "kitti.txt")
    assert len(np.loadtxt(tmp_path / "kitti.txt")) == 5
    run(room, tmp_path / "fresh", chosen=(3, 4))
    behind, fresh = (rgbd_io.load_flow(place / "flow" / f"{NAMES[3]}.npz").result
                     for place in (out, tmp_path / "fresh"))
    np.testing.assert_array_equal(behind.flow, fresh.flow)
    np.testing.assert_array_equal(behind.b, fresh.b)


def test_a_frame_that_shows_nothing_of_the_one_before_is_skipped(room, tmp_path, lidarflow):
    data, out = copy_of(room, tmp_path / "data"), tmp_path / "run"
    speck = np.pad(np.full((1, 1), 5000, np.uint16), ((120, 119), (160, 159)))
    Image.fromarray(speck).save(data / "depth" / f"{NAMES[2]}.png")
    said = lidarflow.complaint("rgbd", "run", data, "--out", out, "--no-record")
    assert "seen again" in said and "(frames 1 and 2 of" in said and "flow of 1 before is kept" in said
    told = lidarflow.ok("rgbd", "run", data, "--out", out, "--no-record", "--resume", "--skip-bad")
    assert "skipped    frame 2: odometry: 0%" in told and "2 pairs are left" in told
    assert sorted(os.listdir(out / "flow")) == [f"{NAMES[0]}.npz", f"{NAMES[3]}.npz"]


def test_frames_behind_one_that_was_mended_are_computed_again(room, tmp_path, unbroken):
    """What a pair takes over from the one before is not there behind a gap."""
    data, out = copy_of(room, tmp_path / "data", damaged=(1,)), tmp_path / "run"

    def stop(report):
        if report.frame == NAMES[3]:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(data, out, going=Going(skip_bad=True), on_pair=stop)
    assert sorted(RgbdCheckpoints(out).found()) == [2, 3]
    copy_of(room, data)
    run(data, out, going=Going(resume=True, skip_bad=True))
    mended = contents(out)
    assert {name: mended[name] for name in mended if name != "source.json"} == {
        name: unbroken[name] for name in unbroken if name != "source.json"}


def test_nothing_but_damaged_frames(room, tmp_path, lidarflow):
    data = copy_of(room, tmp_path / "data", damaged=range(FRAMES))
    said = lidarflow.complaint("rgbd", "run", data, "--out", tmp_path / "run", "--skip-bad")
    assert "no two neighbouring frames" in said and f"{NAMES[0]}.png" in said
    assert not (tmp_path / "run").exists()


def test_drift_is_not_taken_over_a_gap():
    true = np.stack([pose.from_translation([0.1 * k, 0.0, 0.0]) for k in range(6)])
    estimated = true.copy()
    estimated[3:, 1, 3] += 1.0     # a guess between the third and the fourth
    times_ns = np.arange(6) * 333_333_333
    stretch = np.array([0, 0, 0, 1, 1, 1])
    whole, parts = (rgbd_metrics.drift(estimated, true, times_ns, given) for given in (None, stretch))
    assert (whole.frames, parts.frames) == (5, 4)
    assert whole.per_frame_m > 0.4 and whole.per_second_m > 0.9
    assert parts.per_frame_m < 1e-9 and np.isnan(parts.per_second_m)

"""Nothing is lost: runs that are killed, run out of space or meet damaged scans, and go on afterwards."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from cloud_files import message
from command_line import street_folder
from killed import contents, program, was_killed

from lidarflow import flow_files, io, pose
from lidarflow.checkpoints import Checkpoints, packed
from lidarflow.config import Config
from lidarflow.datasets import open_dataset
from lidarflow.errors import DataError
from lidarflow.lidar.tracking import Tracks
from lidarflow.methods import METHODS
from lidarflow.runner import Going, Viewing, process
from lidarflow.stepping import Walk, steps

QUIET = Viewing(record=False)
SCANS = 5


@pytest.fixture(scope="module")
def street(tmp_path_factory):
    return street_folder(tmp_path_factory.mktemp("street"), SCANS)


@pytest.fixture(scope="module")
def unbroken(street, tmp_path_factory):
    """The bytes of a run over the street that nothing disturbed."""
    out = tmp_path_factory.mktemp("unbroken") / "run"
    process(open_dataset(street), list(range(SCANS)), Config(), out, QUIET)
    assert not (out / io.RESUME_FOLDER).exists()
    return contents(out)


@pytest.fixture
def damaged(street, tmp_path):
    """The street with its third scan cut off."""
    folder = tmp_path / "damaged"
    folder.mkdir()
    for file in street.iterdir():
        (folder / file.name).write_bytes(file.read_bytes()[:-7 if file.stem == "000002" else None])
    return folder


# Killed at a moment that is chosen.

@pytest.mark.parametrize("place, number, how", [
    ("os.replace", 1, "before"),                                # before the settings are there
    ("os.replace", 2, "after"),                                 # after what the run is made of
    ("lidarflow.io.archive", 2, "before"),                      # first flow file there, no checkpoint
    ("lidarflow.io.archive", 3, "after"),                       # second flow file about to be written
    ("lidarflow.checkpoints.packed", 3, "before"),              # flow file in place, checkpoint not
    ("os.replace", 8, "before"),
    ("lidarflow.io.write_objects", 1, "before"),                # all pairs done, nothing put together
    ("lidarflow.io.write_json", 3, "after"),                    # only the checkpoints to be removed
])
def test_a_killed_run_resumes_to_the_same_bytes(street, unbroken, tmp_path, place, number, how):
    out = tmp_path / "run"
    words = ("run", street, "--out", out, "--no-record", "--resume")
    assert was_killed(program(words, place, number, how))
    done = program(words)
    assert done.returncode == 0, done.stderr
    assert contents(out) == unbroken
    assert not list(tmp_path.rglob(".*.part"))


def test_pairs_that_are_kept_are_not_computed_again(street, unbroken, tmp_path, monkeypatch):
    out = tmp_path / "run"
    killed = program(("run", street, "--out", out, "--no-record"), "lidarflow.checkpoints.packed", 4)
    assert was_killed(killed) and sorted(Checkpoints(out).found()) == [0, 1, 2]
    computed = []
    estimator = METHODS["ours"].along(Config())
    for step in steps(Walk.of_scans(open_dataset(street), estimator), list(range(SCANS)), Checkpoints(out)):
        computed += [] if step.restored else [step.index]
    assert computed == [3]
    process(open_dataset(street), list(range(SCANS)), Config(), out, QUIET, going=Going(resume=True))
    assert contents(out) == unbroken


@pytest.mark.slow
def test_a_run_killed_again_and_again_at_any_moment_resumes(street, unbroken, tmp_path):
    out, rng = tmp_path / "run", np.random.default_rng(3)
    words = [sys.executable, "-c", "from lidarflow.cli import main; main()",
             "run", str(street), "--out", str(out), "--resume", "--no-record"]
    kills = 0
    for _ in range(40):
        running = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
                                   start_new_session=True)
        seen = len(list(out.glob("*/*.npz")))
        while running.poll() is None and len(list(out.glob("*/*.npz"))) == seen:
            time.sleep(0.01)
        time.sleep(float(rng.uniform(0.0, 0.5)))
        if running.poll() is not None:
            break
        os.killpg(running.pid, signal.SIGKILL)
        running.wait()
        kills += 1
    assert running.wait() == 0, running.stderr.read()
    assert kills >= 3
    assert contents(out) == unbroken


@pytest.mark.parametrize("method", ["zero", "ego", "icp", "ransac_icp"])
def test_every_method_goes_on_as_if_nothing_had_happened(street, tmp_path, method):
    data, frames, config = open_dataset(street), list(range(SCANS)), Config()
    process(data, frames, config, tmp_path / "whole", QUIET, method=method)

    def stop(report):
        if report.frame == "000002":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        process(data, frames, config, tmp_path / "cut", QUIET, stop, method)
    process(data, frames, config, tmp_path / "cut", QUIET, method=method, going=Going(resume=True))
    assert contents(tmp_path / "cut") == contents(tmp_path / "whole")


def test_a_resumed_run_records_all_pairs(street, tmp_path, lidarflow):
    out = tmp_path / "run"
    assert was_killed(program(("run", street, "--out", out), "lidarflow.checkpoints.packed", 3))
    assert not (out / "recording.rrd").exists()
    lidarflow.ok("run", street, "--out", out, "--resume")
    lidarflow.ok("run", street, "--out", tmp_path / "whole")
    sizes = [(folder / "recording.rrd").stat().st_size for folder in (out, tmp_path / "whole")]
    assert abs(sizes[0] - sizes[1]) < 0.02 * sizes[1]


# What may be resumed.

def test_another_run_is_not_resumed(street, tmp_path, lidarflow):
    out, other = tmp_path / "run", tmp_path / "other"
    other.mkdir()
    for file in street.iterdir():
        (other / file.name).write_bytes(file.read_bytes())
    assert was_killed(program(("run", street, "--out", out), "lidarflow.checkpoints.packed", 2))
    before = contents(out)
    for words, found in (
            ((street, "--set", "mesh.max_edge_m=0.5"), "with mesh.max_edge_m = "),
            ((street, "--method", "icp"), "(Method: ours), not (Method: icp)"),
            ((other,), f"from {street} (folder"), ((street, "-n", 3), "from scans 0 to 4, not 0 to 2"),
            ((street, "-j", 1), "from scans 0 to 4, not 1 to 4")):
        said = lidarflow.complaint("run", *words, "--out", out, "--resume")
        assert found in said and "--resume" in said
    assert contents(out) == before


def test_data_that_changed_are_noticed(street, tmp_path, lidarflow):
    data, out = tmp_path / "data", tmp_path / "run"
    data.mkdir()
    for file in street.iterdir():
        (data / file.name).write_bytes(file.read_bytes())
    assert was_killed(program(("run", data, "--out", out), "lidarflow.checkpoints.packed", 3))
    first = np.fromfile(data / "000000.bin", "<f4")
    first[0] += 1.0
    first.tofile(data / "000000.bin")
    assert "the data changed" in lidarflow.complaint("run", data, "--out", out, "--resume", "--skip-bad")


def test_a_complete_run_has_nothing_left_to_do(street, tmp_path, lidarflow):
    out = tmp_path / "run"
    words = ("run", street, "--out", out, "--resume", "-n", 2, "--method", "zero", "--no-record")
    lidarflow.ok(*words)      # nothing there yet: begins anew
    before = {file: file.stat().st_mtime_ns for file in out.rglob("*")}
    assert "nothing is left to do" in lidarflow.ok(*words)
    assert {file: file.stat().st_mtime_ns for file in out.rglob("*")} == before
    lidarflow.ok(*words[:4], *words[5:])
    assert {file: file.stat().st_mtime_ns for file in out.rglob("*")} != before


def truncate(file):
    file.write_bytes(file.read_bytes()[:-30])


@pytest.mark.parametrize("name, harm", [
    ("flow/000001.npz", Path.unlink), ("flow/000001.npz", truncate), ("poses_tum.txt", Path.unlink),
    ("timing.json", truncate)])
def test_a_complete_run_that_lost_something_is_made_whole(street, tmp_path, lidarflow, name, harm):
    out = tmp_path / "run"
    words = ("run", street, "--out", out, "--resume", "-n", 4, "--method", "icp", "--no-record")
    lidarflow.ok(*words)
    whole = contents(out)
    harm(out / name)
    assert f"damaged    {out}: {name} is missing or cut off" in lidarflow.ok(*words)
    assert contents(out) == whole and "nothing is left to do" in lidarflow.ok(*words)


def test_flow_files_that_an_interrupted_run_lost_are_written_again(street, unbroken, tmp_path):
    out = tmp_path / "run"
    words = ("run", street, "--out", out, "--no-record", "--resume")
    assert was_killed(program(words, "lidarflow.io.write_objects", 1))
    (out / "flow" / "000000.npz").unlink()
    truncate(out / "flow" / "000001.npz")
    assert program(words).returncode == 0
    assert contents(out) == unbroken


# Checkpoints.

def test_a_checkpoint_comes_back_to_the_last_bit(street, tmp_path):
    for method in METHODS:
        estimator, kept = METHODS[method].along(Config()), Checkpoints(tmp_path / method)
        for step in steps(Walk.of_scans(open_dataset(street), estimator), [0, 1, 2]):
            kept.save(step.index, step.pair, step.result, step.tracks, step.stretch)
            result, tracks = kept.load(step.index, step.pair)
            assert kept.stretch(step.index) == step.stretch
            assert packed(step.pair, result, tracks, step.stretch) == kept.file(step.index).read_bytes()
            for name in ("flow", "motions", "valid", "std_m", "object_id", "match_target", "ego_motion"):
                np.testing.assert_array_equal(getattr(result, name), getattr(step.result, name))
            assert result.seconds == step.result.seconds and len(result.objects) == len(step.result.objects)
            assert tracks.next_id == step.tracks.next_id
            for found, made in zip(tracks.followed, step.tracks.followed, strict=True):
                np.testing.assert_array_equal(found.points, made.points)
                np.testing.assert_array_equal(found.over_ground, made.over_ground)
                assert (found.id, found.took_s, found.missed) == (made.id, made.took_s, made.missed)


def test_a_damaged_checkpoint_is_named(street, tmp_path):
    kept = Checkpoints(tmp_path)
    step = next(steps(Walk.of_scans(open_dataset(street), METHODS["zero"].along(Config())), [0, 1]))
    kept.save(0, step.pair, step.result, step.tracks, step.stretch)
    file, = kept.folder.iterdir()
    file.write_bytes(file.read_bytes()[:-30])
    assert str(file) in message(kept.load, 0, step.pair)


def test_a_checkpoint_of_another_layout_is_refused_in_one_line(street, tmp_path, lidarflow):
    out = tmp_path / "run"
    assert was_killed(program(("run", street, "--out", out), "lidarflow.checkpoints.packed", 3))
    file = Checkpoints(out).file(1)
    with np.load(file) as archive:
        arrays = dict(archive)
    del arrays["track_took_s"]
    file.write_bytes(io.archive(arrays))
    said = lidarflow.complaint("run", street, "--out", out, "--resume", "--skip-bad")
    assert f"{file}: lacks track_took_s" in said and "without --resume" in said


# Damaged scans.

def test_a_damaged_scan_stops_the_run_and_everything_before_is_kept(damaged, tmp_path, lidarflow, unbroken):
    out = tmp_path / "run"
    said = lidarflow.complaint("run", damaged, "--out", out, "--no-record")
    assert "000002.bin" in said and "flow of 1 before is kept" in said and "--skip-bad" in said
    assert (out / "flow" / "000000.npz").read_bytes() == unbroken["flow/000000.npz"]


@pytest.mark.parametrize("resumed", [False, True])
def test_a_damaged_scan_is_skipped_and_counted(damaged, tmp_path, lidarflow, resumed):
    out = tmp_path / "run"
    if resumed:
        lidarflow.complaint("run", damaged, "--out", out, "--no-record")
    told = lidarflow.ok("run", damaged, "--out", out, "--skip-bad", *(["--resume"] if resumed else ()))
    assert "skipped    scan 2: " in told and "000002.bin" in told and "skipped    1 of 5 scans; 2" in told
    assert sorted(os.listdir(out / "flow")) == ["000000.npz", "000003.npz"]
    scored = json.loads((out / "metrics.json").read_text())
    assert [scan["scan"] for scan in scored["skipped"]] == [2] and len(scored["pairs"]) == 2
    assert json.loads((out / "source.json").read_text())["skipped"] == [2]
    poses = np.loadtxt(out / "poses_kitti.txt").reshape(-1, 3, 4)
    assert len(poses) == 5 and len(np.loadtxt(out / "poses_tum.txt")) == 4
    step = pose.identity()
    step[:3] = poses[1]
    np.testing.assert_allclose((pose.identity() @ step @ step @ step)[:3], poses[3], atol=1e-9)
    ids = [row.split(",")[:2] for row in (out / "objects.csv").read_text().splitlines()[1:]]
    before, after = ({number for frame, number in ids if frame == name} for name in ("000000", "000003"))
    assert before and not before & after      # a number is never given to another object
    lidarflow.ok("report", out, "--out", tmp_path / "report.html")
    told = lidarflow.ok("run", damaged, "--out", out, "--skip-bad", "--resume")
    assert told.endswith(f"complete   {out}: nothing is left to do\n"
                         "left out   2: if usable by now, run again without --resume\n")


def test_the_pair_after_a_gap_is_that_of_a_run_that_begins_there(damaged, street, tmp_path):
    process(open_dataset(damaged), list(range(SCANS)), Config(), tmp_path / "gap", QUIET,
            going=Going(skip_bad=True))
    process(open_dataset(street), [3, 4], Config(), tmp_path / "fresh", QUIET)
    gap, fresh = (flow_files.load_flow(tmp_path / name / "flow" / "000003.npz") for name in ("gap", "fresh"))
    np.testing.assert_array_equal(gap.flow, fresh.flow)
    np.testing.assert_array_equal(gap.object_id >= 0, fresh.object_id >= 0)


def stopped(data, out, last, **going):
    """A run that is interrupted once the pair `last` is kept."""
    def stop(report):
        if report.frame == last:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        process(open_dataset(data), list(range(SCANS)), Config(), out, QUIET, stop, going=Going(**going))


def resumed(data, out):
    """The bytes of a run that goes on and leaves out bad scans."""
    process(open_dataset(data), list(range(SCANS)), Config(), out, QUIET,
            going=Going(resume=True, skip_bad=True))
    return contents(out)


def test_a_scan_that_was_mended_leaves_no_trace(damaged, street, unbroken, tmp_path):
    stopped(damaged, tmp_path / "run", "000003", skip_bad=True)
    (damaged / "000002.bin").write_bytes((street / "000002.bin").read_bytes())
    mended = resumed(damaged, tmp_path / "run")
    assert {name: mended[name] for name in mended if name != "source.json"} == {
        name: unbroken[name] for name in unbroken if name != "source.json"}


def test_a_scan_that_was_damaged_since_is_left_out_as_if_it_had_always_been(damaged, street, tmp_path):
    whole, cut = ((place / "000002.bin").read_bytes() for place in (street, damaged))
    (damaged / "000002.bin").write_bytes(whole)
    stopped(damaged, tmp_path / "run", "000003")
    (damaged / "000002.bin").write_bytes(cut)
    found = resumed(damaged, tmp_path / "run")
    assert found == resumed(damaged, tmp_path / "fresh")
    assert [name for name in found if name.startswith("flow/")] == ["flow/000000.npz", "flow/000003.npz"]


class Counting:
    """An estimator whose answers tell all they rest on: the scans since the last gap, and free numbers."""

    def __init__(self):
        self.tracks = Tracks()
        self.reset()

    def reset(self):
        self._seen = ()

    def step(self, scan):
        self._seen += ((scan, self.tracks.next_id),)
        if len(self._seen) == 1:
            return None
        self.tracks = Tracks(next_id=self.tracks.next_id + len(self._seen) % 3)
        return self._seen

    def follow(self, scan, known, tracks):
        self._seen, self.tracks = known, tracks


class Memory(dict):
    """Checkpoints that are kept in memory, (stretch, answer, tracks) by index."""

    def found(self):
        return frozenset(self)

    def stretch(self, index):
        return self[index][0]

    def load(self, index, pair):
        return self[index][1:]


def test_whatever_becomes_good_or_bad_between_interruptions_leaves_no_trace():
    rng, count = np.random.default_rng(5), 12

    def gone_through(bad, kept, most):
        def read(index):
            if index in bad:
                raise DataError("bad")
            return index

        walk = Walk("made up", "scans", read, lambda source, target: (source, target), Counting())
        found = []
        for step in steps(walk, list(range(count)), kept, lambda skipped: None):
            found.append((step.index, step.result, step.tracks.next_id))
            kept[step.index] = step.stretch, step.result, step.tracks
            if len(found) == most:
                break
        return found

    for _ in range(300):
        kept = Memory()
        for _ in range(4):
            bad = set(np.flatnonzero(rng.random(count) < 0.2).tolist())
            gone_through(bad, kept, int(rng.integers(1, count)))
        assert gone_through(bad, kept, count) == gone_through(bad, Memory(), count)


def test_nothing_but_damaged_scans(street, tmp_path, lidarflow):
    data = tmp_path / "data"
    data.mkdir()
    for file in street.iterdir():
        (data / file.name).write_bytes(file.read_bytes()[:-7])
    said = lidarflow.complaint("run", data, "--out", tmp_path / "run", "--skip-bad")
    assert "no two neighbouring scans" in said and "000000.bin" in said
    assert not (tmp_path / "run").exists()


# Discs.

def small_disc(folder, megabytes):
    """A file system of this size mounted on `folder`, or a skipped test where that is not allowed."""
    folder.mkdir()
    words = ["mount", "-t", "tmpfs", "-o", f"size={int(1024 * megabytes)}k", "tmpfs", str(folder)]
    if sys.platform != "linux" or subprocess.run(words, capture_output=True, check=False).returncode:
        pytest.skip("a small file system can only be mounted by root on Linux")


@pytest.mark.parametrize("record", ["--record", "--no-record"])
def test_a_full_disk_is_one_line_and_the_run_goes_on_when_there_is_space(street, unbroken, tmp_path, record):
    disc = tmp_path / "disc"
    small_disc(disc, 2)
    try:
        words = ("run", street, "--out", disc / "run", record, "--resume")
        done = program(words)
        assert done.returncode == 1 and "Traceback" not in done.stderr
        assert done.stderr.startswith("lidarflow: ") and done.stderr.count("\n") == 1, done.stderr
        assert "No space left" in done.stderr or "cannot be written" in done.stderr
        assert not list(disc.rglob("*.part"))
        for file in (disc / "run").rglob("*.npz"):
            np.load(file).close()
        subprocess.run(["mount", "-o", "remount,size=200m", str(disc)], check=True)
        done = program(words)
        assert done.returncode == 0, done.stderr
        assert contents(disc / "run") == unbroken
    finally:
        subprocess.run(["umount", "-l", str(disc)], check=False)


def test_a_recording_that_does_not_fit_is_not_taken_for_one(street, tmp_path):
    """Rerun only logs that it could not write; the command notices that the end is missing."""
    disc = tmp_path / "disc"
    small_disc(disc, 0.5)
    try:
        pair = sorted(street.iterdir())[:2]
        done = program(("pair", *pair, "--out", tmp_path / "flow.npz", "--recording", disc / "flow.rrd"))
        assert done.returncode == 1 and done.stderr.count("\n") == 1, done.stderr
        assert "is the disk full?" in done.stderr or "No space left" in done.stderr
        assert os.listdir(disc) == [] and not (tmp_path / "flow.npz").exists()
    finally:
        subprocess.run(["umount", "-l", str(disc)], check=False)


def test_files_that_may_not_grow_are_one_line(street, tmp_path, monkeypatch, lidarflow):
    def full(*args, **kwargs):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    said = lidarflow.complaint("run", street, "--out", tmp_path / "run", "--method", "zero", "--no-record")
    assert "No space left" in said and not list(tmp_path.rglob("*.part"))


def test_a_read_only_place_is_one_line(street, tmp_path, lidarflow):
    disc = tmp_path / "disc"
    small_disc(disc, 1)
    try:
        subprocess.run(["mount", "-o", "remount,ro", str(disc)], check=True)
        for words in (("run", street, "--out", disc / "run"),
                      ("pair", street / "000000.bin", street / "000001.bin", "--out", disc / "flow.npz")):
            assert "cannot" in lidarflow.complaint(*words)
        assert os.listdir(disc) == []
    finally:
        subprocess.run(["umount", "-l", str(disc)], check=False)


def test_an_unreadable_run_folder_is_a_lidarflow_error(street, tmp_path):
    (tmp_path / "run").write_text("a file")
    with pytest.raises(DataError):
        process(open_dataset(street), [0, 1], Config(), tmp_path / "run", QUIET)

"""Runs on several processes: the same files, whatever happens to a worker."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
from command_line import street_folder
from killed import contents, program

pytest.importorskip("distributed", reason="Dask distributed is not installed: pip install 'lidarflow[dask]'")

from lidarflow import cluster, flow_files, io
from lidarflow.checkpoints import Checkpoints, Numbers, numbers_of, packed, renumbered
from lidarflow.cluster import WARM_UP_PAIRS, WARM_UP_SCANS, Chunk
from lidarflow.config import Config, EgoConfig
from lidarflow.datasets import open_dataset
from lidarflow.methods import METHODS
from lidarflow.runner import Going, Viewing, process
from lidarflow.stepping import Walk, steps
from lidarflow.types import ScanPair

SCANS = 9
QUIET = Viewing(record=False)


@pytest.fixture(scope="module")
def street(tmp_path_factory):
    return street_folder(tmp_path_factory.mktemp("street"), SCANS)


@pytest.fixture(scope="module")
def alone(street, tmp_path_factory):
    """What one process makes of the street."""
    out = tmp_path_factory.mktemp("alone") / "run"
    process(open_dataset(street), list(range(SCANS)), Config(), out, QUIET)
    return in_common(out)


def in_common(out):
    """All files of a run; its settings without the line that says whether it was computed in chunks."""
    found = contents(out)
    found["config.toml"] = found["config.toml"].partition(b"\n")[2]
    assert not any(name.startswith(".") for name in found)
    return found


@contextlib.contextmanager
def machines(folder, workers):
    """A scheduler and workers, each a process of its own, on loopback; the address, and the workers."""
    file = folder / "scheduler.json"
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
    dask = [sys.executable, "-m", "dask"]
    started = [subprocess.Popen([*dask, "scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard",
                                 "--scheduler-file", str(file)], **quiet)]
    try:
        deadline = time.monotonic() + 60
        while not file.is_file() and time.monotonic() < deadline:
            time.sleep(0.1)
        address = json.loads(file.read_text())["address"]
        assert address.startswith("tcp://127.0.0.1:")
        started += [subprocess.Popen(
            [*dask, "worker", address, "--host", "127.0.0.1", "--nthreads", "1", "--no-nanny",
             "--no-dashboard", "--local-directory", str(folder / f"worker{k}")], env=environment, **quiet)
            for k in range(workers)]
        yield address, started[1:]
    finally:
        for running in reversed(started):
            running.terminate()
            running.wait(30)


# Whole runs.

def test_workers_here_give_the_same_files(street, alone, tmp_path):
    out = tmp_path / "run"
    done = program(("run", street, "--out", out, "--workers", 2, "--chunk", 3, "--no-record"))
    assert done.returncode == 0, done.stderr
    assert "workers    2, 3 chunks of up to 3 pairs" in done.stdout and done.stderr == ""
    assert in_common(out) == alone
    assert "in chunks of 3 pairs" in (out / "config.toml").read_text()


def test_a_worker_that_is_killed_costs_nothing(street, alone, tmp_path):
    out = tmp_path / "run"
    with machines(tmp_path, 2) as (address, workers):
        paths = os.pathsep.join(sys.path)
        running = subprocess.Popen(
            [sys.executable, "-c", "from lidarflow.cli import main; main()", "run", str(street), "--out",
             str(out), "--scheduler", address, "--chunk", "2", "--no-record"], text=True,
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, env={**os.environ, "PYTHONPATH": paths})
        deadline = time.monotonic() + 120
        while not list(out.glob(".resume/*/done")) and running.poll() is None and time.monotonic() < deadline:
            time.sleep(0.02)
        os.kill(workers[0].pid, signal.SIGKILL)      # in the middle of its next chunk
        assert len(list(out.glob(".resume/*/done"))) < 4
        told, complained = running.communicate(timeout=300)
        assert running.returncode == 0, complained
        assert "workers    2" in told or "workers    1" in told
    assert in_common(out) == alone


def test_a_killed_run_of_several_workers_resumes(street, alone, tmp_path, lidarflow):
    out = tmp_path / "run"
    words = ("run", street, "--out", out, "--workers", 1, "--chunk", 3, "--no-record", "--resume")
    assert program(words, "lidarflow.io.write_text", 5).returncode == -signal.SIGKILL
    done = [file.parent.name for file in out.glob(".resume/*/done")]
    assert 0 < len(done) < 3
    assert "in chunks of 3 pairs" in lidarflow.complaint("run", street, "--out", out, "--resume")
    assert program(words).returncode == 0
    assert in_common(out) == alone


def test_a_chunk_that_fails_costs_no_other(street, tmp_path, lidarflow):
    data, out = tmp_path / "data", tmp_path / "run"
    data.mkdir()
    for file in street.iterdir():
        (data / file.name).write_bytes(file.read_bytes()[:-7 if file.stem == "000008" else None])
    words = ("run", data, "--workers", 1, "--chunk", 3, "--no-record")
    failed = program((*words, "--out", out))
    assert failed.returncode == 1 and failed.stderr.count("\n") == 1, failed.stderr
    assert "1 of 3 chunks failed, the first from scan 6 on" in failed.stderr and "000008.bin" in failed.stderr
    assert len(list(out.glob(".resume/*/done"))) == 2
    done = program((*words, "--out", out, "--resume", "--skip-bad"))
    assert done.returncode == 0 and "skipped    scan 8" in done.stdout
    lidarflow.ok("run", data, "--out", tmp_path / "alone", "--skip-bad", "--no-record")
    assert in_common(out) == in_common(tmp_path / "alone")


def test_what_is_missing_is_said_in_one_line(street, tmp_path, lidarflow, monkeypatch):
    run = ("run", street, "--out", tmp_path / "run")
    assert "both are given" in lidarflow.complaint(*run, "--workers", 2, "--scheduler", "tcp://127.0.0.1:1")
    assert "only with --workers" in lidarflow.complaint(*run, "--chunk", 2)
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert "lidarflow[dask]" in lidarflow.complaint(*run, "--workers", 2)
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
def test_no_scheduler_is_one_line(street, tmp_path):
    done = program(("run", street, "--out", tmp_path / "run", "--scheduler", "tcp://127.0.0.1:1"))
    assert done.returncode == 1 and "no Dask scheduler answers" in done.stderr.splitlines()[-1]


@pytest.mark.parametrize("address", ["foo", "foo:1", "xyz://127.0.0.1:1", "tcp://127.0.0.1"])
def test_what_is_no_address_is_one_line(street, tmp_path, address):
    out = tmp_path / "run"
    done = program(("run", street, "--out", out, "--scheduler", address))
    assert done.returncode == 1 and done.stderr.count("\n") == 1, done.stderr
    assert f"--scheduler {address}: no Dask scheduler answers" in done.stderr
    assert not out.exists()


def test_workers_here_are_reached_from_here_only():
    import psutil

    before = os.environ.get("NUMBA_NUM_THREADS")
    with cluster.connected(1, None) as client:
        processes = [psutil.Process(), *psutil.Process().children(recursive=True)]
        listening = [connection.laddr.ip for process in processes for connection in process.net_connections()
                     if connection.status == psutil.CONN_LISTEN]
        assert client.submit(os.getenv, "NUMBA_NUM_THREADS").result() == "1"
        assert client.submit(os.getenv, "OMP_NUM_THREADS").result() == "1"
        assert set(client.nthreads().values()) == {1}
    assert os.environ.get("NUMBA_NUM_THREADS") == before, "this process has threads of its own"
    assert len(listening) >= 3 and set(listening) == {"127.0.0.1"}


# Chunks.

@pytest.mark.parametrize("method, shown", [("registration", 0), ("kiss_icp", WARM_UP_SCANS)])
@pytest.mark.parametrize("first, last, pairs", [(0, 40, 20), (3, 47, 10), (0, 1, 20), (5, 9, 1)])
def test_chunks_hold_every_pair_once(first, last, pairs, method, shown):
    config = replace(Config(), ego=EgoConfig(method=method))
    chunks = cluster.chunks_of(list(range(first, last + 1)), pairs, config)
    counted = [index for chunk in chunks for index in range(chunk.start, chunk.stop)]
    assert counted == list(range(first, last))
    for chunk in chunks:
        assert first <= chunk.seen <= chunk.begin <= chunk.start < chunk.stop <= last
        assert chunk.begin == max(first, chunk.start - WARM_UP_PAIRS)
        assert chunk.seen == max(first, chunk.begin - shown)


def test_objects_keep_their_numbers_across_chunks(street, tmp_path):
    """The second chunk has numbers of its own: 10 + n, those it shares with the first in another order."""
    kept, data = Checkpoints(tmp_path), open_dataset(street)
    whole = list(steps(Walk.of_scans(data, METHODS["ours"].along(Config())), [0, 1, 2, 3, 4]))
    for step in whole:
        kept.save(step.index, step.pair, step.result, step.tracks, step.stretch)
    chunks = [Chunk(0, 0, 0, 2), Chunk(0, 0, 2, 4)]
    expected = [numbers_of(kept.file(index)) for index in range(4)]
    seen = sorted({number for numbers in expected for number in numbers.tolist() if number >= 0})
    shared = [number for number in seen if (np.concatenate(expected[:2]) == number).any()]
    assert 3 < len(shared) < len(seen)
    other = {number: 10 + place for place, number in enumerate(
        [*reversed(shared), *(number for number in seen if number not in shared)])}
    for chunk in chunks:
        folder = kept.folder / f"chunk_{chunk.start:06d}"
        folder.mkdir()
        for index in range(chunk.begin, chunk.stop):
            step = whole[index]
            content = packed(step.pair, step.result, step.tracks, step.stretch)
            (folder / f"{index:06d}.npz").write_bytes(content)
            if chunk.start:
                numbers = Numbers(dict(other), 99)
                file = folder / f"{index:06d}.npz"
                file.write_bytes(io.archive(renumbered(file, numbers, whole[index].stretch)))
    for index in range(4):
        kept.file(index).unlink()
    cluster.join(chunks, kept)
    for index in range(4):
        np.testing.assert_array_equal(numbers_of(kept.file(index)), expected[index])
        result, tracks = kept.load(index, whole[index].pair)
        assert [found.id for found in result.objects] == [found.id for found in whole[index].result.objects]
        assert {track.id for track in tracks.followed} <= set(seen) and tracks.next_id <= max(seen) + 1


@pytest.mark.slow
@pytest.mark.parametrize("method, seen", [("registration", 16), ("kiss_icp", 6)])
def test_chunks_differ_little_where_the_warm_up_does_not_reach_the_start(tmp_path, method, seen):
    """Odometry has seen less of the way than in one go: the flow of nearly all points is the same to 1 mm."""
    scans = 26
    dataset = open_dataset(street_folder(tmp_path / "data", scans, columns=200, seed=2))
    frames = list(range(scans))
    config = replace(Config(), ego=EgoConfig(method=method))
    chunk = cluster.chunks_of(frames, 20, config)[1]
    assert chunk.seen == seen
    process(dataset, frames, config, tmp_path / "run", QUIET)
    computed = cluster.explain_chunk(dataset.source, chunk, config, "ours", False)
    kept = Checkpoints(tmp_path)
    for index, content in computed.checkpoints:
        kept.put(index, content)
    for index in range(chunk.start, chunk.stop):
        pair = ScanPair(dataset.scan(index), dataset.scan(index + 1))
        one_go = flow_files.load_flow(tmp_path / "run" / "flow" / f"{pair.source.name}.npz")
        result, _ = kept.load(index, pair)
        assert np.nanquantile(np.linalg.norm(one_go.flow - result.flow, axis=1), 0.9) < 1e-3
        assert (one_go.is_dynamic != result.is_dynamic).mean() < 0.02


def test_a_run_in_chunks_is_another_run(street, tmp_path, lidarflow):
    process(open_dataset(street), [0, 1, 2], Config(), tmp_path / "run", QUIET, method="zero",
            going=Going(chunk=0))
    said = lidarflow.complaint("run", street, "-n", 3, "--out", tmp_path / "run", "--method", "zero",
                               "--resume", "--workers", 1)
    assert "in chunks of 20 pairs" in said

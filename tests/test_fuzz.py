"""Thousands of damaged files: each is refused in one line or read, and nothing else ever happens."""

import json
import os
import pickle
import subprocess
import sys

import numpy as np
import pytest
from cloud_files import message
from shared_data import ROOT, with_paths

from lidarflow import flow_files
from lidarflow.datasets import argoverse2_map
from lidarflow.datasets.base import read_truth
from lidarflow.datasets.clouds import load_arrays, read_points


def fuzzed(count, seed, folder):
    """What `count` mutated files came to: the last line, and the lines on files that went wrong."""
    done = subprocess.run(
        [sys.executable, str(ROOT / "tests" / "fuzzing.py"), str(count), str(seed), str(folder)],
        capture_output=True, text=True, timeout=1800, env=with_paths(ROOT / "tests"), check=False)
    left = [file.name for file in folder.glob("now_*")]
    assert done.returncode == 0 and not left, f"died at {left}: {done.stderr[-2000:]}"
    *wrong, summary = map(json.loads, done.stdout.splitlines())
    return summary, wrong


def test_hundreds_of_damaged_files(tmp_path):
    summary, wrong = fuzzed(600, 1, tmp_path)
    assert not wrong and summary["files"] == summary["well"] == 600 and summary["kinds"] >= 38


@pytest.mark.slow
def test_ten_thousands_of_damaged_files(tmp_path):
    summary, wrong = fuzzed(24_000, 7, tmp_path)
    assert not wrong and summary["files"] == summary["well"] == 24_000


class Bomb:
    """Leaves a file where it is unpickled."""

    def __init__(self, mark):
        self.mark = mark

    def __reduce__(self):
        return os.mkdir, (str(self.mark),)


@pytest.mark.parametrize("name, read", [
    ("a.npz", read_points), ("a.npy", read_points), ("a.npz", flow_files.load_flow), ("a.npz", load_arrays),
    ("a.npz", lambda file: read_truth(file, 1, "0")), ("a.npy", argoverse2_map._read_raster)])
def test_no_pickle_is_ever_loaded(tmp_path, name, read):
    mark = tmp_path / "unpickled"
    bomb = np.array([Bomb(mark)], object)
    with (tmp_path / name).open("wb") as file:
        if name.endswith(".npz"):
            keys = ("points", *flow_files._ROW_ARRAYS, *flow_files._WHOLE_ARRAYS, "dynamic", "track",
                    "target_from_source")
            np.savez(file, **dict.fromkeys(keys, bomb))
        else:
            np.save(file, bomb, allow_pickle=True)
    assert "pickle" in message(read, tmp_path / name)
    (tmp_path / name).write_bytes(pickle.dumps(Bomb(mark)))
    message(read, tmp_path / name)
    assert not mark.exists()
    pickle.loads((tmp_path / name).read_bytes())
    assert mark.is_dir(), "the pickle is a live one"


def test_a_header_that_announces_a_trillion_points_costs_nothing(tmp_path):
    file = tmp_path / "a.npy"
    np.save(file, np.zeros((4, 3)))
    file.write_bytes(file.read_bytes().replace(b"(4, 3), }       ", b"(9999999999, 3),"[:-1] + b"}"))
    assert "says (9999999999, 3)" in message(read_points, file)


def test_only_hosts_of_this_machine_are_ever_listened_on():
    for file in (ROOT / "lidarflow").rglob("*.py"):
        text = file.read_text(encoding="utf-8")
        assert "0.0.0.0" not in text and "INADDR_ANY" not in text, file

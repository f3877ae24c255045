"""Whoever waits for kernels to be compiled is told: by the command line, or by the library's logger."""

import logging
import subprocess
import sys
import threading

import pytest
from command_line import drive
from rgbd_worlds import QVGA, frames

import lidarflow as library
from lidarflow import first_use
from lidarflow.methods import METHODS
from lidarflow.rgbd import RgbdEstimator

SAID = "first use: compiling for this machine takes one to four minutes; later starts skip it"
PROGRAM = """
import numpy as np
from lidarflow import FlowEstimator, first_use
first_use.are_cached = lambda: False
for _ in range(2):
    FlowEstimator().step(np.ones((50, 3)))
"""


@pytest.fixture
def untold(monkeypatch):
    """As in a new process."""
    monkeypatch.setattr(first_use, "_told", threading.Event())


@pytest.fixture
def uncompiled(untold, monkeypatch):
    """As on a machine where no kernel was compiled."""
    monkeypatch.setattr(first_use, "are_cached", lambda: False)


def computed(kind: str) -> None:
    """The first step of a sequence, or a pair."""
    source, target = (scan.points for scan, _ in drive()[:2])
    if kind == "pair":
        library.estimate_flow((source, target), library.load(overrides=("solver.method=fast",)))
    elif kind == "sequence":
        library.FlowEstimator().step(source)
    elif kind == "baseline":
        METHODS["zero"].along(library.Config()).step(library.Scan(source))
    else:
        RgbdEstimator(QVGA).step(frames()[0][0])


@pytest.mark.parametrize("kind", ["pair", "sequence", "baseline", "rgbd"])
def test_a_program_is_told_once_by_the_logger(uncompiled, caplog, kind):
    for _ in range(2):
        computed(kind)
    assert [(record.name, record.levelno, record.getMessage()) for record in caplog.records] == [
        ("lidarflow", logging.WARNING, SAID)]


def test_nobody_is_told_where_kernels_are_there(untold, monkeypatch, caplog):
    monkeypatch.setattr(first_use, "are_cached", lambda: True)
    computed("sequence")
    assert not caplog.records


def test_a_program_that_arranged_nothing_shows_it_on_standard_error():
    done = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("", SAID + "\n")


@pytest.mark.parametrize("words", [
    ("pair", "{scans[0]}", "{scans[1]}", "--out", "{out}/flow.npz"),
    ("run", "{kitti}", "-n", "2", "--out", "{out}/run", "--no-record"),
    ("compare", "{kitti}", "-n", "2", "--methods", "ego"),
])
def test_a_command_says_one_plain_line_where_standard_error_is_no_terminal(
        lidarflow, uncompiled, caplog, kitti, scans, tmp_path, words):
    code, out, err = lidarflow(*(word.format(kitti=kitti, scans=scans, out=tmp_path) for word in words))
    assert (code, err) == (0, SAID + "\n") and SAID not in out
    assert not caplog.records, "the command has told"


def test_a_command_says_nothing_where_kernels_are_there(lidarflow, untold, monkeypatch, kitti):
    monkeypatch.setattr(first_use, "are_cached", lambda: True)
    lidarflow.ok("compare", kitti, "-n", "2", "--methods", "ego")

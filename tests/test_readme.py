"""What README says is run: every command and every example, on small generated data."""

import re
import shlex

import numpy as np
import pytest
from command_line import Program, drive
from rgbd_worlds import QVGA, frames
from shared_data import ROOT

from lidarflow import rerun_streams, synthetic
from lidarflow.datasets.clouds import _READERS
from lidarflow.export import FORMATS
from lidarflow.settings import read_toml

README = (ROOT / "README.md").read_text(encoding="utf-8")
COMMANDS = re.findall(r"^    \.venv/bin/lidarflow (.*?)(?: +#.*)?$", README, re.MULTILINE)
EXAMPLES = re.findall(r"^```python\n(.*?)^```", README, re.MULTILINE | re.DOTALL)
FILES = {"COLOR0": "rgb/0.000000.png", "DEPTH0": "depth/0.000000.png",
         "COLOR1": "rgb/0.033333.png", "DEPTH1": "depth/0.033333.png"}
ELSEWHERE = ("tcp://", "…", "...")     # what needs other machines, or stands for anything
NO_WINDOW = ("--visualize",)           # what a test leaves out: it opens the viewer


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with all that README's commands are given, by the names that it uses."""
    folder = tmp_path_factory.mktemp("readme")
    synthetic.write_kitti(folder / "KITTI", drive()[:2])
    synthetic.write_tum(folder / "TUM_FOLDER", frames()[:2], QVGA)
    (folder / "FOLDER_OF_CLOUDS").mkdir()
    for k, (scan, _) in enumerate(drive()[:2]):
        np.save(folder / "FOLDER_OF_CLOUDS" / f"{k}.npy", scan.points.astype(np.float32))
        (folder / f"scan{k}.bin").write_bytes(
            (folder / "KITTI" / "sequences" / "00" / "velodyne" / f"{k:06d}.bin").read_bytes())
    return folder


@pytest.fixture
def lidarflow(monkeypatch, capsys, place):
    monkeypatch.chdir(place)
    return Program(monkeypatch, capsys)


@pytest.mark.slow
def test_every_command_works_in_the_order_of_the_page(lidarflow, place, monkeypatch):
    opened = []
    monkeypatch.setattr(rerun_streams, "open_in_viewer", opened.append)
    monkeypatch.setattr(rerun_streams, "require_display", lambda *_: None)
    tried = [command for command in COMMANDS if not any(mark in command for mark in ELSEWHERE)]
    assert len(tried) >= 14 and {shlex.split(command)[0] for command in tried} >= {
        "pair", "view", "run", "eval", "report", "compare", "export", "config", "rgbd"}
    for command in tried:
        words = [f"TUM_FOLDER/{FILES[word]}" if word in FILES else word for word in shlex.split(command)]
        words = [word for word in words if word not in NO_WINDOW]
        code, _, err = lidarflow(*words)
        assert code == 0, f"lidarflow {command}: {err}"
        if "--out" in words:
            assert (place / words[words.index("--out") + 1]).exists(), command
    views = [command for command in tried if command.startswith("view")]
    assert len(opened) == len(views) > 0
    assert (place / "runs" / "kitti00-ply" / "000000.ply").is_file()


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda example: example.split("\n", 1)[0])
def test_every_example_runs(example, place, monkeypatch):
    monkeypatch.chdir(place)
    exec(compile(example, "README.md", "exec"), {})


def test_there_are_examples():
    assert len(EXAMPLES) >= 3 and len(COMMANDS) >= 14


def test_every_format_and_every_extra_is_named():
    for name in FORMATS:
        assert f"`{name}`" in README, name
    project = read_toml(ROOT / "pyproject.toml")["project"]
    for extra in project["optional-dependencies"].keys() - {"dev"}:
        assert re.search(rf"[`\[]{extra}[`\]]", README), extra


def test_the_clouds_that_can_be_read_and_their_axes_are_told():
    told, = re.findall(r"^Clouds may be (.*?); data sets are", README, re.MULTILINE | re.DOTALL)
    assert set(_READERS) <= set(re.findall(r"\.[a-z]+\b", told))
    assert "in metres, with z up" in told

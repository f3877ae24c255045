"""What several test modules begin with: the program, where it is run, and a small drive on disk."""

import pytest
from command_line import Program, drive

from lidarflow import synthetic


@pytest.fixture
def lidarflow(monkeypatch, capsys):
    return Program(monkeypatch, capsys)


@pytest.fixture
def in_tmp_path(monkeypatch, tmp_path):
    """Stay in the test's own folder: what is written to a relative place lands there."""
    monkeypatch.chdir(tmp_path)


@pytest.fixture(scope="session")
def kitti(tmp_path_factory):
    """The small drive in KITTI's odometry layout, with truth and poses."""
    folder = tmp_path_factory.mktemp("drive") / "data"
    synthetic.write_kitti(folder, drive())
    return folder


@pytest.fixture(scope="session")
def scans(kitti):
    return sorted((kitti / "sequences" / "00" / "velodyne").iterdir())

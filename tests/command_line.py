"""The program as its user meets it, and a small generated drive for it to work on."""

import functools
import sys

import numpy as np
import pytest
from cloud_files import write_bin

from lidarflow import cli, first_use, synthetic


@functools.cache
def drive():
    """Three sparse scans of a street, 0.1 s apart, with their truth."""
    rng = np.random.default_rng(0)
    return synthetic.scan_sequence(synthetic.street(rng), synthetic.hdl64e(columns=300), 3, rng)


def street_folder(folder, scans, columns=300, seed=1):
    """A folder of sparse scans of a street, with objects that are followed over the pairs."""
    rng = np.random.default_rng(seed)
    drive = synthetic.scan_sequence(synthetic.street(rng), synthetic.hdl64e(columns=columns), scans, rng)
    for k, (scan, _) in enumerate(drive):
        write_bin(folder / f"{k:06d}.bin", scan.points)
    return folder


def rounded(points):
    """Points (N, 3) as float32 files hold them."""
    return points.astype(np.float32).astype(np.float64)


class Program:
    """`lidarflow` in this process: its exit code, and what it wrote where."""

    def __init__(self, monkeypatch, capsys):
        self._monkeypatch, self._capsys = monkeypatch, capsys
        for name in ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET"):
            monkeypatch.delenv(name, raising=False)
        monkeypatch.setenv("COLUMNS", "80")
        first_use.is_known()     # the first test on a machine compiles

    def __call__(self, *words):
        """(exit code, stdout, stderr) of `lidarflow WORDS`."""
        self._capsys.readouterr()
        self._monkeypatch.setattr(sys, "argv", ["lidarflow", *map(str, words)])
        with pytest.raises(SystemExit) as stop:
            cli.main()
        written = self._capsys.readouterr()
        return stop.value.code or 0, written.out, written.err

    def ok(self, *words):
        """What a command that works writes to stdout; stderr stays empty where it is no terminal."""
        code, out, err = self(*words)
        assert (code, err) == (0, ""), err
        return out

    def complaint(self, *words):
        """The one line of a command that finds a problem with data or settings."""
        code, _, err = self(*words)
        assert code == 1 and err.startswith("lidarflow: ") and err.endswith("\n"), err
        assert err.count("\n") == 1 and "Traceback" not in err
        return err.removeprefix("lidarflow: ").rstrip("\n")


def rests(folder):
    """Files below `folder` that a failed write left."""
    return [str(file) for file in folder.rglob("*") if file.name.endswith(".part")]

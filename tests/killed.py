"""`lidarflow run` in a process of its own, killed at a chosen moment."""

import signal
import subprocess
import sys

from shared_data import with_paths

# Counts the calls of a function by its dotted name and dies like `kill -9` before, or in the middle of, one.
_DRIVER = """
import importlib, os, signal, sys
from lidarflow import cli

def die(*args, **kwargs):
    os.kill(os.getpid(), signal.SIGKILL)

place, number, how = {place!r}, {number}, {how!r}
if place:
    module, _, name = place.rpartition(".")
    owner = importlib.import_module(module)
    real, calls = getattr(owner, name), [0]

    def counted(*args, **kwargs):
        calls[0] += 1
        if calls[0] == number and how == "before":
            die()
        found = real(*args, **kwargs)
        if calls[0] == number:
            die()
        return found

    setattr(owner, name, counted)
sys.argv = ["lidarflow", *{words!r}]
cli.main()
"""


def program(words, place="", number=0, how="before", **more):
    """`lidarflow WORDS` in a process of its own, which dies at the `number`th call of `place`."""
    code = _DRIVER.format(place=place, number=number, how=how, words=[str(word) for word in words])
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=600,
                          env=with_paths(), check=False, **more)


def was_killed(done):
    return done.returncode == -signal.SIGKILL


def contents(folder):
    """Bytes of all files that equal runs have in common: recordings hold random ids, timing.json times."""
    return {str(file.relative_to(folder)): file.read_bytes() for file in sorted(folder.rglob("*"))
            if file.is_file() and file.name not in ("recording.rrd", "timing.json")}

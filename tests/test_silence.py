"""What extension modules write is not heard, whoever else is silencing; afterwards all is as before."""

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest

from lidarflow.silence import silenced


@pytest.mark.parametrize("descriptor", [1, 2])
def test_what_is_written_past_python_is_not_heard(capfd, descriptor):
    with silenced(descriptor):
        os.write(descriptor, b"greeting")
    os.write(descriptor, b"result")
    assert "".join(capfd.readouterr()) == "result"


def test_the_last_thread_out_ends_the_silence(capfd):
    first, second = silenced(1), silenced(1)
    with ThreadPoolExecutor(1) as one, ThreadPoolExecutor(1) as other:
        one.submit(first.__enter__).result()
        other.submit(second.__enter__).result()
        one.submit(first.__exit__, None, None, None).result()
        os.write(1, b"greeting")
        other.submit(second.__exit__, None, None, None).result()
    os.write(1, b"result")
    assert capfd.readouterr().out == "result"


def test_a_failure_ends_the_silence_too_and_nothing_stays_open(capfd):
    before = os.listdir("/dev/fd")
    with pytest.raises(ValueError, match="no ground"), silenced(1), silenced(1):
        raise ValueError("no ground")
    os.write(1, b"result")
    assert capfd.readouterr().out == "result"
    assert len(os.listdir("/dev/fd")) == len(before)


@pytest.mark.skipif(os.name != "posix", reason="descriptors are closed by a POSIX shell")
def test_a_daemon_without_streams_is_silent_anyway():
    program = f"""
import os, sys
from lidarflow.silence import silenced
assert sys.stdout is None is sys.stderr
with silenced(1), silenced(2):
    pass
sys.stdout = open({os.devnull!r}, "w")
sys.stdout.close()
with silenced(1):
    pass
"""
    closed = ["sh", "-c", '"$0" -c "$1" >&- 2>&-', sys.executable, program]
    assert subprocess.run(closed, timeout=60, check=False).returncode == 0

"""A signal while kernels run ends them, wherever it comes, and crashes nothing."""

import os
import subprocess
import sys

import pytest

PROGRAM = """
import signal
import time
import numpy as np
from lidarflow import estimate_flow, interrupts, synthetic

signal.signal(signal.SIGALRM, interrupts.deferred(signal.default_int_handler))
(source, _), (target, _) = synthetic.scan_sequence(
    synthetic.street(np.random.default_rng(0)), synthetic.hdl64e(columns=500), 2, np.random.default_rng(1))
estimate_flow((source, target))
begin = time.perf_counter()
estimate_flow((source, target))
took_s = time.perf_counter() - begin
interrupted = 0
for share in np.linspace(0.01, 0.9, 60):
    try:
        signal.setitimer(signal.ITIMER_REAL, share * took_s)
        estimate_flow((source, target))
        time.sleep(0.1)
    except KeyboardInterrupt:
        interrupted += 1
print(interrupted)
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no interval timers here")
@pytest.mark.parametrize("threads", ["1", "2"])
def test_a_signal_is_an_interrupt_and_no_crash(threads):
    """With one thread all kernels run where Python looks for signals."""
    ended = subprocess.run(
        [sys.executable, "-c", PROGRAM], env=os.environ | {"NUMBA_NUM_THREADS": threads},
        capture_output=True, text=True, timeout=600)
    assert ended.returncode == 0, ended.stderr[-1000:]
    assert int(ended.stdout) >= 55

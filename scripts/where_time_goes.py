"""Milliseconds of one core that a pair spends in each kernel, in Patchwork++, and in NumPy and Python.

    python scripts/where_time_goes.py FOLDER… [--pairs 10] [--top 15]

Everything runs in one thread, one thing after the other, so that times of the parts add up to that of a pair:
it is what two cores share, not how long a pair takes them (scripts/benchmark.py). Scans are in memory and
every kernel has run before; the first two scans are left out: their pair begins with nothing. A kernel's time
holds that of the kernels that it calls, and of the call from Python.
"""

import argparse
import math
import os
import sys
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path

os.environ["NUMBA_NUM_THREADS"] = "1"     # before numba is loaded: see lidarflow/aside.py

from evaluate import table
from numba.core.dispatcher import Dispatcher

from lidarflow.config import Config
from lidarflow.datasets import open_dataset
from lidarflow.lidar import ground
from lidarflow.pipeline import FlowEstimator
from lidarflow.types import Scan

LEFT_OUT = 2      # scans: the first has no pair, the second's begins with nothing
PATCHWORK, REST, WHOLE = "Patchwork++", "NumPy and Python", "whole pair"


class Clock:
    """Milliseconds of processor time by name, over all calls of what it watches."""

    def __init__(self):
        self.spent_ms: dict[str, float] = defaultdict(float)

    def watched(self, name: str, function: Callable) -> Callable:
        def timed(*given, **named):
            begin = time.thread_time()
            try:
                return function(*given, **named)
            finally:
                self.spent_ms[name] += 1e3 * (time.thread_time() - begin)

        return timed

    def watch_all(self) -> None:
        """Watch Patchwork++ and every kernel, by whatever name modules of the package call it.

        Kernels must have run before: where one is compiled, it must find the others as they are.
        """
        ground._patchwork = self.watched(PATCHWORK, ground._patchwork)
        for name, module in list(sys.modules.items()):
            if not name.startswith("lidarflow."):
                continue
            for called, kernel in list(vars(module).items()):
                if isinstance(kernel, Dispatcher):
                    home = kernel.py_func.__module__.rpartition(".")[2]
                    setattr(module, called, self.watched(f"{home}.{kernel.py_func.__name__}", kernel))


def spent_ms(scans: list[Scan], times: int, clock: Clock) -> dict[str, float]:
    """Milliseconds a pair by name, without each lap's first pair; REST is what of WHOLE is not watched."""
    total_ms: dict[str, float] = defaultdict(float)
    for _ in range(times):
        estimator = FlowEstimator(Config())
        for index, scan in enumerate(scans):
            clock.spent_ms.clear()
            begin = time.process_time()
            estimator.step(scan)
            whole_ms = 1e3 * (time.process_time() - begin)
            if index >= LEFT_OUT:
                watched = dict(clock.spent_ms)
                for name, ms in {**watched, WHOLE: whole_ms, REST: whole_ms - sum(watched.values())}.items():
                    total_ms[name] += ms
    return {name: ms / (times * (len(scans) - LEFT_OUT)) for name, ms in total_ms.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--pairs", type=int, default=10, help="at least so many of each folder")
    parser.add_argument("--top", type=int, default=15, help="rows for as many kernels")
    options = parser.parse_args()
    sequences = []
    for folder in options.folders:
        dataset = open_dataset(folder)
        count = min(len(dataset), options.pairs + LEFT_OUT)
        sequences.append([dataset.scan(index) for index in range(count)])
    clock = Clock()
    for scans in sequences:
        spent_ms(scans, 1, clock)
    clock.watch_all()
    found = [spent_ms(scans, laps(scans, options.pairs), clock) for scans in sequences]
    print(table(["ms of one core", *(folder.name for folder in options.folders)], rows(found, options.top)))


def laps(scans: list[Scan], pairs: int) -> int:
    return math.ceil(pairs / (len(scans) - LEFT_OUT))


def rows(found: list[dict[str, float]], top: int) -> list[list[str]]:
    """What takes most first, as many kernels as `top`; the others together."""
    kernels = sorted({name for one in found for name in one} - {WHOLE, REST, PATCHWORK},
                     key=lambda name: -sum(one.get(name, 0.0) for one in found))
    named = {name: [one.get(name, 0.0) for one in found] for name in (*kernels[:top], PATCHWORK, REST)}
    others = f"{len(kernels[top:])} other kernels"
    named[others] = [sum(one.get(name, 0.0) for name in kernels[top:]) for one in found]
    by_size = sorted(named, key=lambda name: -sum(named[name]))
    return [[name, *(f"{ms:.0f}" for ms in named[name])] for name in by_size] + [
        [WHOLE, *(f"{one[WHOLE]:.0f}" for one in found)]]


if __name__ == "__main__":
    main()

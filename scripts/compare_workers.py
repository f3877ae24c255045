"""How much faster several workers process a sequence than one, and whether they write the same files.

    python scripts/compare_workers.py FOLDER [--workers 2] [--chunk 13] [--times 3] [--n-scans N]

Runs `lidarflow run FOLDER --no-record --workers …` in turns with one worker and with --workers of them, each
a process with one thread for its kernels, and without any, as a run on one machine is. The chunks are the
same for both, so that what is computed is. Seconds are medians over --times whole commands after one that is
not counted, from start to end: starting workers, warm-up pairs of the chunks, scores and output are in them.
The last line is for the estimate of hours in README.md. Exits with 1 where the files differ.
"""

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from evaluate import table
from soak import digest

from lidarflow.runner import OUTPUT_STAGE


def seconds_of(data: Path, out: Path, options: list[str]) -> float:
    """Wall time of one command; RuntimeError with what it said where it fails."""
    begin = time.perf_counter()
    program = str(Path(sys.executable).with_name("lidarflow"))
    done = subprocess.run([program, "run", str(data), "--out", str(out), "--no-record", *options],
                          capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(done.stderr)
    return time.perf_counter() - begin


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--chunk", type=int, default=13)
    parser.add_argument("--times", type=int, default=3)
    parser.add_argument("--n-scans", type=int)
    given = parser.parse_args()
    some = ["--n-scans", str(given.n_scans)] if given.n_scans else []
    ways = {"one process, all threads": [], "1 worker": ["--workers", "1", "--chunk", str(given.chunk)],
            f"{given.workers} workers": ["--workers", str(given.workers), "--chunk", str(given.chunk)]}
    seconds: dict[str, list[float]] = {way: [] for way in ways}
    made, pairs, timing = {}, 0, {}
    with tempfile.TemporaryDirectory() as folder:
        for turn in range(given.times + 1):
            for number, (way, options) in enumerate(ways.items()):
                out = Path(folder) / f"{turn}_{number}" / "run"
                took = seconds_of(given.folder, out, [*options, *some])
                if turn:
                    seconds[way].append(took)
                made[way] = digest(out)
                if way == "1 worker":
                    timing = json.loads((out / "timing.json").read_text())
                    pairs = len(timing)
    median = {way: statistics.median(taken) for way, taken in seconds.items()}
    one, several = (way for way in ways if "worker" in way)
    print(f"{given.folder.name}: {pairs} pairs, {given.times} times each\n")
    print(table(["way", "s", "s / pair", "times one worker"],
                [[way, f"{took:.1f}", f"{took / pairs:.2f}", f"{median[one] / took:.2f}"]
                 for way, took in median.items()]))
    is_same = made[one] == made[several]
    print(f"\nfiles of {one} and of {several}: {'the same' if is_same else 'NOT THE SAME'}")
    output = statistics.median(stages[OUTPUT_STAGE] for stages in timing.values())
    whole = statistics.median(sum(stages.values()) for stages in timing.values())
    print(f"with one thread: {whole - output:.2f} s a pair, {output:.2f} s of output a pair")
    if not is_same:
        sys.exit(1)


if __name__ == "__main__":
    main()

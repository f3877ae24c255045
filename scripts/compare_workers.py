"""How much faster several workers process a sequence than one, and whether they write the same files.

    python scripts/compare_workers.py FOLDER [--workers 2] [--chunk 13] [--times 3] [--laps N]

Runs `lidarflow run FOLDER --no-record --workers …` in turns with one worker and with --workers of them, each
a process with one thread for its kernels, and without any, as a run on one machine is. The chunks are the
same for both, so that what is computed is. Seconds are medians over --times whole commands, from start to
end: starting workers, warm-up pairs of the chunks, scores and output are in them. A short run of each before
is not counted. --laps goes through the .bin scans of FOLDER from first to last and back so many times, for
more pairs than there are: what a start costs is spread over a whole sequence.
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

from lidarflow import io
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


def there_and_back(scans: Path, laps: int, folder: Path) -> Path:
    """A folder of links to the scans, through which they are passed so often; `scans` itself for no laps."""
    if laps == 0:
        return scans
    files = sorted(scans.glob("*.bin"))
    folder.mkdir()
    for number, file in enumerate((files + files[-2:0:-1]) * laps):
        (folder / f"{number:06d}.bin").symlink_to(file.resolve())
    return folder


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--chunk", type=int, default=13)
    parser.add_argument("--times", type=int, default=3)
    parser.add_argument("--laps", type=int, default=0)
    given = parser.parse_args()
    ways = {"one process, all threads": [], "1 worker": ["--workers", "1", "--chunk", str(given.chunk)],
            f"{given.workers} workers": ["--workers", str(given.workers), "--chunk", str(given.chunk)]}
    seconds: dict[str, list[float]] = {way: [] for way in ways}
    made, pairs, timing = {}, 0, {}
    with tempfile.TemporaryDirectory() as folder:
        data = there_and_back(given.folder, given.laps, Path(folder) / given.folder.name)
        for options in ways.values():
            seconds_of(data, Path(folder) / "short", [*options, "--n-scans", "4"])
        for turn in range(given.times):
            for number, (way, options) in enumerate(ways.items()):
                out = Path(folder) / f"{turn}_{number}" / "run"
                seconds[way].append(seconds_of(data, out, options))
                made[way] = digest(out)
                if way == "1 worker":
                    timing = json.loads((out / io.TIMING_FILE).read_text())
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

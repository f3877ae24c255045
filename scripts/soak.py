"""Process the same scans again and again: memory, threads and open files must not grow, results not change.

    python scripts/soak.py FOLDER [--rounds 10] [--scans N] [--solver gtsam] [--record]

FOLDER is any data set, e.g. the 52 range images of moosmann_durlacher_tor. Every round is a run as
`lidarflow run` makes it, all in one process. Prints a row a round and says in the end whether the rounds were
equal; exits with 1 where they were not, or where something grew. What is held of memory is exact; what is
resident also has what allocators keep for later, which comes and goes.
"""

import argparse
import ctypes
import gc
import hashlib
import resource
import statistics
import sys
import tempfile
import threading
import time
from pathlib import Path

from lidarflow import io, runner
from lidarflow.config import SolverConfig, load
from lidarflow.datasets import open_dataset

TIMED = (io.TIMING_FILE, io.RECORDING_FILE)  # hold times, and ids that are drawn anew
WARM_UP_ROUNDS = 2                           # compilers and memory pools have settled after these
MOST_HELD_MIB = 4                            # that what is held may grow
MOST_GROWTH = 0.15                           # of what is resident: what allocators keep goes up and down


def digest(folder):
    """One hash over names and contents of all files of a run that do not hold times."""
    found = hashlib.sha256()
    for file in sorted(folder.rglob("*")):
        if file.is_file() and file.name not in TIMED:
            found.update(str(file.relative_to(folder)).encode())
            found.update(file.read_bytes())
    return found.hexdigest()


def resident_mib():
    """Memory of this process that is in use now; the most so far where the system does not tell."""
    statm = Path("/proc/self/statm")
    if statm.exists():
        return int(statm.read_text().split()[1]) * resource.getpagesize() / 2**20
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10


def held_mib():
    """Memory that this process has asked malloc for and not given back; 0 where the system does not tell."""
    try:
        info = ctypes.CDLL(None).mallinfo2
    except (OSError, AttributeError):
        return 0.0
    info.restype = Mallinfo
    found = info()
    return (found.uordblks + found.hblkhd) / 2**20


class Mallinfo(ctypes.Structure):
    """What glibc's mallinfo2 tells: bytes in its heaps (uordblks), and in maps of their own (hblkhd)."""

    _fields_ = [(name, ctypes.c_size_t) for name in (
        "arena", "ordblks", "smblks", "hblks", "hblkhd", "usmblks", "fsmblks", "uordblks", "fordblks",
        "keepcost")]


def open_files():
    """Open file handles of this process; 0 where the system does not tell."""
    handles = Path("/proc/self/fd")
    return len(list(handles.iterdir())) if handles.exists() else 0


def system_threads():
    """Threads of this process, those of compiled libraries among them where the system tells."""
    tasks = Path("/proc/self/task")
    return len(list(tasks.iterdir())) if tasks.exists() else threading.active_count()


def round_of(dataset, frames, settings, method, record, folder):
    """(seconds, MiB held, MiB resident, threads, open files, hash) of one run."""
    begin = time.perf_counter()
    runner.process(dataset, frames, settings, folder, runner.Viewing(record=record), method=method)
    spent_s = time.perf_counter() - begin
    gc.collect()
    return spent_s, held_mib(), resident_mib(), system_threads(), open_files(), digest(folder)


def growth(rounds):
    """What grew from after the warm-up on, in words; what is resident, from the first half to the last."""
    _, before_mib, _, threads, files, _ = rounds[min(WARM_UP_ROUNDS, len(rounds)) - 1]
    _, after_mib, _, more_threads, more_files, _ = rounds[-1]
    grew = []
    if after_mib - before_mib > MOST_HELD_MIB:
        grew.append(f"memory held from {before_mib:.1f} to {after_mib:.1f} MiB")
    resident = [row[2] for row in rounds[WARM_UP_ROUNDS:]]
    half = len(resident) // 2
    if half:
        first_mib, last_mib = statistics.median(resident[:half]), statistics.median(resident[half:])
        if last_mib > (1.0 + MOST_GROWTH) * first_mib:
            grew.append(f"resident memory from {first_mib:.0f} to {last_mib:.0f} MiB")
    if more_threads > threads:
        grew.append(f"threads from {threads} to {more_threads}")
    if more_files > files:
        grew.append(f"open files from {files} to {more_files}")
    return grew


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--rounds", type=int, default=10)
    parser.add_argument("--scans", type=int)
    parser.add_argument("--method", default="ours")
    parser.add_argument("--solver", default=SolverConfig().method)
    parser.add_argument("--record", action="store_true",
                        help="record too; rerun 0.41 keeps some threads of every recording")
    options = parser.parse_args()
    settings = load(overrides=(f"solver.method={options.solver}",))
    dataset = open_dataset(options.folder)
    frames = runner.choose_frames(dataset, 0, options.scans)
    print(f"{dataset.name}: {len(frames)} scans, {options.rounds} rounds, method {options.method}")
    print("round  seconds  MiB held  resident  threads  open files  results")
    rounds = []
    for number in range(options.rounds):
        with tempfile.TemporaryDirectory() as folder:
            rounds.append(round_of(
                dataset, frames, settings, options.method, options.record, Path(folder) / "run"))
        spent_s, held, resident, threads, files, found = rounds[-1]
        print(f"{number + 1:5}  {spent_s:7.1f}  {held:8.1f}  {resident:8.0f}  {threads:7}  {files:10}  "
              f"{found[:16]}", flush=True)
    grew, results = growth(rounds), {found for *_, found in rounds}
    print(f"results: {'equal' if len(results) == 1 else f'{len(results)} different ones'}")
    print(f"growth after round {min(WARM_UP_ROUNDS, len(rounds))}: {', '.join(grew) or 'none'}")
    sys.exit(1 if grew or len(results) > 1 else 0)


if __name__ == "__main__":
    main()

"""A run on several processes or machines, by Dask distributed.

The pairs of a sequence are split into chunks. A worker computes a chunk as a run of its own: odometry sees
some scans before it, some pairs before it are computed too, so that what is carried from pair to pair is
there when the chunk begins. What comes back are checkpoints, of which `runner.process` makes the run as it
does when a run is resumed. Objects of neighbouring chunks are the same where the pairs that both computed
say so.
"""

import contextlib
import logging
import os
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lidarflow import first_use, io, methods
from lidarflow.checkpoints import (
    Checkpoints,
    Numbers,
    Stretch,
    numbers_of,
    packed,
    renumbered,
    stretch_of,
)
from lidarflow.config import Config
from lidarflow.datasets import Dataset, Source, open_dataset
from lidarflow.errors import DataError, InstallError, LidarflowError
from lidarflow.lidar.tracking import Tracks
from lidarflow.pipeline import Estimator
from lidarflow.stepping import Skipped, Walk, steps

CHUNK_PAIRS = 20
WARM_UP_PAIRS = 4      # an object that is missed is expected for three more
WARM_UP_SCANS = 10     # before these, with KISS-ICP, until its map and thresholds have settled
_RETRIES = 2
_HERE = "127.0.0.1"      # nobody else is to reach what runs on this machine
_SAME_SHARE = 0.5      # of an object's points, for it to be the same in two chunks
# Set in the workers once they run: what Dask sets before it starts one stays in this process too, where numba
# would take fright at another number of threads than it has.
_THREADS = {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1",
            "NUMBA_NUM_THREADS": "1", "OMP_WAIT_POLICY": "passive"}
# Dask has its workers give memory back at once; arrays as large as ours would be mapped anew every time.
_TRIMMED = "distributed.nanny.pre-spawn-environ.MALLOC_TRIM_THRESHOLD_"


@dataclass(frozen=True, slots=True)
class Chunk:
    """Pairs that are computed in one go, by the indices of their source scans.

    seen   first scan that odometry sees
    begin  first pair that is computed
    start  first pair that counts
    stop   the last pair's target
    """

    seen: int
    begin: int
    start: int
    stop: int


@dataclass(frozen=True, slots=True)
class Computed:
    """Checkpoints of a chunk by index, its warm-up included, and why it ended early, "" if it did not."""

    checkpoints: tuple[tuple[int, bytes], ...]
    error: str


def chunks_of(frames: list[int], pairs: int, config: Config) -> list[Chunk]:
    """The chunks of so many `pairs` each, the last one shorter, that the scans `frames` are split into."""
    first, last = frames[0], frames[-1]
    seen = WARM_UP_SCANS if config.ego.method == "kiss_icp" else 0
    return [Chunk(max(first, start - WARM_UP_PAIRS - seen), max(first, start - WARM_UP_PAIRS), start,
                  min(start + pairs, last)) for start in range(first, last, pairs)]


def explain_chunk(source: Source, chunk: Chunk, config: Config, method: str, skip_bad: bool,
                  pinned: bool = False) -> Computed:
    """Compute a chunk of a data set; what a worker is asked to do.

    pinned  keep to one core, that of the worker's number, for libraries that take as many as there are
    """
    _use_one_thread(pinned)
    if pinned:     # on this machine, where the command has told
        first_use.is_known()
    dataset = open_dataset(source.folder, source.loader, source.sequence, source.kitti_correction)
    estimator = methods.find(method).along(config)
    _let_see(estimator, dataset, range(chunk.seen, chunk.begin))
    found = []
    try:
        frames = list(range(chunk.begin, chunk.stop + 1))
        for step in steps(Walk.of_scans(dataset, estimator), frames, None, _ignored if skip_bad else None):
            found.append((step.index, packed(step.pair, step.result, step.tracks, step.stretch)))
    except LidarflowError as error:
        return Computed(tuple(found), " ".join(str(error).split()))
    return Computed(tuple(found), "")


def compute(
    dataset: Dataset, chunks: list[Chunk], config: Config, method: str, kept: Checkpoints, client,
    skip_bad: bool = False, pinned: bool = False, on_chunk: Callable[[Chunk], None] = lambda chunk: None,
) -> None:
    """Have all chunks that are not `kept` yet computed, and keep them; `on_chunk` hears of every one done.

    A chunk whose worker dies is given to another. Raises DataError at the end where chunks failed all the
    same; the others are kept by then.
    """
    from distributed import as_completed

    failed: dict[int, str] = {}
    waiting = {}
    for chunk in chunks:
        if _is_done(kept, chunk):
            on_chunk(chunk)
        else:
            waiting[client.submit(explain_chunk, dataset.source, chunk, config, method, skip_bad, pinned,
                                  pure=False, retries=_RETRIES)] = chunk
    for future in as_completed(list(waiting), loop=client.loop):
        chunk = waiting.pop(future)
        try:
            computed = future.result()
        except Exception as error:     # whatever a worker died of, the other chunks are none the worse
            failed[chunk.start] = f"{type(error).__name__}: {' '.join(str(error).split())}"
            continue
        if computed.error:
            failed[chunk.start] = computed.error
        else:
            _keep(kept, chunk, computed)
            on_chunk(chunk)
    if failed:
        start = min(failed)
        raise DataError(f"{len(failed)} of {len(chunks)} chunks failed, the first from scan {start} on: "
                        f"{failed[start]}; the others are kept, --resume computes only what is missing")


def join(chunks: list[Chunk], kept: Checkpoints) -> None:
    """Make checkpoints of the run out of those of its chunks: every object has one number throughout."""
    next_id, last, stretch = 0, {}, Stretch(chunks[0].begin, 0)
    for chunk in chunks:
        folder = _folder(kept, chunk)
        numbers = Numbers(_same_objects(folder, chunk, last), next_id)
        last, packing = {}, {}
        # Numbers are given in order. Packing anew is what takes time, and needs no order.
        with ThreadPoolExecutor(os.cpu_count()) as threads:
            for index in range(chunk.start, chunk.stop):
                file = folder / f"{index:06d}.npz"
                if file.is_file():     # a scan that was left out has none
                    # Where a worker began is no gap; its other stretches begin behind one.
                    if stretch_of(file).first == index:
                        stretch = Stretch(index, numbers.next_id)
                    arrays = renumbered(file, numbers, stretch)
                    packing[index] = threads.submit(io.archive, arrays)
                    last[index] = arrays["object_id"]
            for index, content in packing.items():
                kept.put(index, content.result())
        next_id = numbers.next_id


def _same_objects(folder: Path, chunk: Chunk, before: dict[int, np.ndarray]) -> dict[int, int]:
    """Numbers in the chunk before of a chunk's objects, by the pairs that both computed, the latest first."""
    same: dict[int, int] = {}
    for index in range(chunk.start - 1, chunk.begin - 1, -1):
        file = folder / f"{index:06d}.npz"
        if index not in before or not file.is_file():
            continue
        here, there = numbers_of(file), before[index]
        for number in np.unique(here[here >= 0]).tolist():
            others = Counter(there[here == number].tolist())
            other, count = others.most_common(1)[0]
            if (other >= 0 and number not in same and other not in same.values()
                    and count >= _SAME_SHARE * others.total()):
                same[number] = other
    return same


@contextlib.contextmanager
def connected(workers: int | None, scheduler: str | None) -> Iterator:
    """A Dask client of `workers` processes on this machine, one thread each, or of a running scheduler.

    Raises InstallError without Dask distributed, DataError where no scheduler answers.
    """
    try:
        import dask
        import distributed
    except ImportError:
        raise InstallError("--workers and --scheduler need Dask distributed; pip install 'lidarflow[dask]'"
                           ) from None
    if scheduler is not None:
        try:
            # A client that is not made with an address may not be ended without a traceback.
            distributed.comm.resolve_address(scheduler)
            client = distributed.Client(scheduler, timeout="10s", set_as_default=False)
        except (OSError, ValueError, TypeError) as error:
            raise DataError(f"--scheduler {scheduler}: no Dask scheduler answers ({type(error).__name__}); "
                            "expected an address such as tcp://HOST:8786") from None
        with client:
            yield client
        return
    local = {"host": _HERE, "dashboard_address": f"{_HERE}:0", "worker_dashboard_address": f"{_HERE}:0"}
    with (dask.config.set({"distributed.nanny.environ": _THREADS, _TRIMMED: None}),
          distributed.LocalCluster(n_workers=workers, threads_per_worker=1, processes=True,
                                   silence_logs=logging.CRITICAL, **local) as cluster,
          distributed.Client(cluster, set_as_default=False) as client):
        yield client


def _use_one_thread(pinned: bool) -> None:
    """One thread for the kernels of this process; `pinned` to one core, what it starts is bound too."""
    import numba

    numba.set_num_threads(1)
    if not pinned or not hasattr(os, "sched_setaffinity"):
        return
    from distributed import get_worker

    number, cores = get_worker().name, sorted(os.sched_getaffinity(os.getpid()))
    if isinstance(number, int) and len(os.sched_getaffinity(0)) > 1:
        os.sched_setaffinity(0, {cores[number % len(cores)]})     # this thread, and those that it starts


def _let_see(estimator: Estimator, dataset: Dataset, frames: range) -> None:
    """Show an estimator scans; one that cannot be used is a new beginning."""
    for frame in frames:
        try:
            estimator.follow(dataset.scan(frame), None, Tracks())
        except LidarflowError:
            estimator.reset()


def _ignored(scan: Skipped) -> None:
    """Scans that are left out are told of when the run is put together."""


def _folder(kept: Checkpoints, chunk: Chunk) -> Path:
    return kept.folder / f"chunk_{chunk.start:06d}"


def _is_done(kept: Checkpoints, chunk: Chunk) -> bool:
    return (_folder(kept, chunk) / "done").is_file()


def _keep(kept: Checkpoints, chunk: Chunk, computed: Computed) -> None:
    folder = _folder(kept, chunk)
    for index, content in computed.checkpoints:
        with io.written_aside(folder / f"{index:06d}.npz") as aside:
            aside.write_bytes(content)
    io.write_text(folder / "done", f"{len(computed.checkpoints)} pairs\n")

"""What `lidarflow run` and `lidarflow demo` do and say, for cli.py."""

import contextlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from lidarflow.errors import ConfigError
from lidarflow.terminal import announce_first_use, check_live_view, progress, resumable, show

if TYPE_CHECKING:
    from collections.abc import Sequence

    from lidarflow.config import Config
    from lidarflow.datasets import Dataset
    from lidarflow.runner import Going, Viewing
    from lidarflow.stepping import Skipped


@dataclass(frozen=True, slots=True)
class Spread:
    """Who computes a run: so many processes here, or a scheduler's workers; pairs a chunk."""

    workers: int | None
    scheduler: str | None
    chunk: int

    @classmethod
    def wanted(cls, workers: int | None, scheduler: str | None, chunk: int | None) -> "Spread | None":
        """What the options say, None for this process alone; ConfigError where they contradict each other."""
        if workers is not None and scheduler is not None:
            raise ConfigError("--workers and --scheduler: both are given; expected one of them")
        if workers is None and scheduler is None:
            if chunk is not None:
                raise ConfigError(f"--chunk {chunk}: only with --workers or --scheduler")
            return None
        from lidarflow import cluster

        return cls(workers, scheduler, chunk or cluster.CHUNK_PAIRS)


def open_data(data: Path, dataloader: str | None, sequence: str | None, settings: "Config") -> "Dataset":
    """The data set, and a word on what it was taken for."""
    from lidarflow.datasets import open_dataset

    dataset = open_dataset(data, dataloader, sequence, settings.preparation.kitti_correction)
    guessed = "" if dataloader else " (guessed from what lies there; --dataloader overrides)"
    print(f"reading    {data}: {len(dataset)} scans")
    print(f"loader     {dataset.loader}{guessed}")
    if dataset.note:
        print(f"note       {dataset.note}")
    return dataset


def say_what_is_idle(names: "Sequence[str]", settings: "Config", along: bool = True) -> None:
    """A note on settings without an effect on methods of these names."""
    from lidarflow import methods

    for line in methods.without_effect(names, settings, along):
        print(f"note       {line}")


@contextlib.contextmanager
def pairs_done(pairs: int):
    """A bar on standard error; yields what to call with the name of every finished pair."""
    announce_first_use()
    with progress("scan pairs", pairs) as bar:
        yield lambda frame: bar.update(0, advance=1, description=f"scan pairs, {frame} done")


def process(
    dataset: "Dataset", settings: "Config", out: Path, viewing: "Viewing", jump: int, n_scans: int | None,
    method: str = "ours", going: "Going | None" = None, spread: Spread | None = None,
) -> None:
    """Run over a data set and say what was found."""
    from lidarflow import runner
    from lidarflow.tables import earlier_run, run_notes, run_table, skipped_lines, where_results_are

    check_live_view(viewing.visualize)
    frames = runner.choose_frames(dataset, jump, n_scans)
    skipped: list[Skipped] = []
    going = replace(going or runner.Going(), on_skip=skipped.append, chunk=spread.chunk if spread else 0)
    said, is_done = earlier_run(dataset, frames, settings, out, method, going)
    if said is not None:
        print(said)
    if is_done:
        return
    with resumable(out):
        if spread is not None:
            _compute(dataset, frames, settings, out, method, going, spread)
            going = replace(going, resume=True)
        with pairs_done(len(frames) - 1) as on_pair:
            reports = runner.process(
                dataset, frames, settings, out, viewing, lambda report: on_pair(report.frame), method, going)
    print()
    for line in skipped_lines(skipped, len(frames), len(reports)):
        print(line)
    show(run_table(reports, settings))
    print()
    for note in run_notes(reports, settings):
        print(note)
    print()
    for line in where_results_are(out, viewing.record):
        print(line)


def _compute(dataset: "Dataset", frames: list[int], settings: "Config", out: Path, method: str,
             going: "Going", spread: Spread) -> None:
    """Have the pairs computed by workers; the run is put together of what they find."""
    from lidarflow import cluster, runner

    chunks = cluster.chunks_of(frames, spread.chunk, settings)
    announce_first_use()
    with cluster.connected(spread.workers, spread.scheduler) as client, progress(
            "scan pairs computed", len(frames) - 1) as bar:
        kept = runner.begin(dataset, frames, settings, out, method, going)
        there = len(client.scheduler_info(n_workers=-1)["workers"])
        print(f"workers    {there}, {len(chunks)} chunks of up to {spread.chunk} pairs")
        cluster.compute(dataset, chunks, settings, method, kept, client, going.skip_bad,
                        spread.scheduler is None, lambda done: bar.update(0, advance=done.stop - done.start))
    cluster.join(chunks, kept)

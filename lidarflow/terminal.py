"""What all commands of the command line share: options, the console, a spinner, the check for a viewer."""

import contextlib
import itertools
import re
import sys
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from lidarflow.errors import ConfigError, DataError

ConfigFile = Annotated[
    Path | None, typer.Option("--config", help="TOML file with differences from the defaults.")]
Visualize = Annotated[bool, typer.Option("--visualize", help="Open the viewer, show results as they come.")]
Resume = Annotated[bool, typer.Option(
    "--resume", help="Go on with a run that was interrupted; the results are the same.")]


def console(file):
    """A rich console on `file`, which shows names of files as they are, not taken for markup or emoji."""
    from rich.console import Console

    return Console(file=file, markup=False, emoji=False, highlight=False)


def show(table) -> None:
    """Write a table to standard output."""
    console(sys.stdout).print(table)


def working(what: str):
    """A spinner on standard error while something long goes on."""
    from rich.text import Text

    return console(sys.stderr).status(Text(what))


def progress(what: str, total: int):
    """A progress bar of `total` steps on standard error, a context manager; its one task is number 0."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    on = console(sys.stderr)
    on.quiet = not on.is_terminal     # before rich 14.3 a disabled bar ends with an empty line
    columns = (TextColumn("{task.description}", markup=False), BarColumn(), MofNCompleteColumn(),
               TimeElapsedColumn())
    bar = Progress(*columns, console=on, disable=not on.is_terminal)
    bar.add_task(what, total=total)
    return bar


def check_words(words: list[str]) -> None:
    """DataError where a word of the command is empty: as a path it would be the working folder."""
    for before, word in itertools.pairwise(["", *words]):
        is_option = re.fullmatch(r"--[a-z-]+=", word) is not None
        if not word or is_option:
            name = word if is_option else before if before.startswith("-") else "an argument"
            raise DataError(f"{name.rstrip('=')}: is empty; expected a value, for the working folder a dot")


def check_exists(what: Path, expected: str) -> None:
    """DataError, which says what is `expected`, where there is nothing at `what`."""
    if not what.exists():
        raise DataError(f"{what}: no such file or folder; expected {expected}")


def check_arrows(wanted: bool, shown: bool, instead: str) -> None:
    """ConfigError where arrows are wanted and nothing is shown or recorded; `instead` is what to ask for."""
    if wanted and not shown:
        raise ConfigError(f"--arrows: nothing is shown or recorded that could have them; {instead}")


@contextlib.contextmanager
def resumable(out: Path):
    """An interruption on the way says, in a note, how the run in `out` goes on, if anything is kept."""
    from lidarflow import io

    try:
        yield
    except (KeyboardInterrupt, SystemExit) as stop:
        if any((out / io.RESUME_FOLDER).rglob("*.npz")):
            stop.add_note(f"finished pairs are kept in {out}, the same command with --resume goes on")
        raise


def notes_of(stop: BaseException | None) -> list[str]:
    """The notes on what ended the program, and on what that came of: typer makes an exit of Ctrl-C."""
    if stop is None:
        return []
    return [*getattr(stop, "__notes__", ()), *notes_of(stop.__cause__ or stop.__context__)]


def announce_first_use() -> None:
    """A line on standard error where kernels have not been compiled on this machine yet."""
    from lidarflow import first_use

    first_use.announce(partial(console(sys.stderr).print, soft_wrap=True))


def check_live_view(wanted: bool) -> None:
    """InstallError before any work where a viewer is wanted and none can be opened."""
    if wanted:
        from lidarflow import rerun_streams

        rerun_streams.require_live_view()

"""Quiet for extension modules that write past Python."""

import contextlib
import os
import sys
import threading
from collections import Counter
from collections.abc import Iterator

_changing = threading.Lock()
_depths: Counter[int] = Counter()     # by descriptor: how many want it silent
_saved: dict[int, int] = {}           # where the silent ones led to


@contextlib.contextmanager
def silenced(descriptor: int) -> Iterator[None]:
    """Send what is written to file `descriptor`, 1 or 2, to nowhere, in the whole process.

    Threads may be in here at once: the first one in silences, the last one out ends it.
    """
    with _changing:
        if not _depths[descriptor]:
            _send_nowhere(descriptor)
        _depths[descriptor] += 1
    try:
        yield
    finally:
        with _changing:
            _depths[descriptor] -= 1
            if not _depths[descriptor]:
                _send_back(descriptor)


def _send_nowhere(descriptor: int) -> None:
    with contextlib.suppress(AttributeError, ValueError):     # a daemon's streams may be None, or closed
        (sys.stdout if descriptor == 1 else sys.stderr).flush()
    try:
        saved = os.dup(descriptor)
    except OSError:     # nothing is open there, so nothing is heard
        return
    try:
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, descriptor)
        os.close(nowhere)
    except OSError:
        os.close(saved)
        raise
    _saved[descriptor] = saved


def _send_back(descriptor: int) -> None:
    saved = _saved.pop(descriptor, None)
    if saved is not None:
        os.dup2(saved, descriptor)
        os.close(saved)

"""The first use on a machine compiles kernels for minutes; whoever waits is told, once in a process.

Programs that use the library are told by the logger "lidarflow": as a warning, which Python shows on standard
error where a program has arranged nothing else.
"""

import logging
import threading
from collections.abc import Callable

from lidarflow.kernels.compiled import are_cached

LINE = "first use: compiling for this machine takes one to four minutes; later starts skip it"
_log = logging.getLogger("lidarflow")
_told = threading.Event()


def announce(tell: Callable[[str], None] = _log.warning) -> None:
    """`tell` LINE where no kernel has been compiled on this machine yet and nobody was told before."""
    if not _told.is_set():
        _told.set()
        if not are_cached():
            tell(LINE)


def is_known() -> None:
    """Have nobody told: who waits for this process knows already."""
    _told.set()

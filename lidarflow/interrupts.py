"""Stopping by a signal, but never within what numba calls back: it would not see the exception, and fail."""

import signal
import sys
import threading
from collections.abc import Callable
from types import FrameType

Handler = Callable[[int, FrameType | None], object]

_SOON_S = 0.005     # a call back takes microseconds


def deferred(handler: Handler) -> Handler:
    """A handler of signals that raises what `handler` raises, a little later if numba would not see it.

    When a kernel ends, numba has Python make its results, and Python looks for signals whenever it is asked
    to do something.
    """

    def handle(number: int, frame: FrameType | None) -> None:
        if _is_called_by_numba(frame):
            threading.Timer(_SOON_S, signal.raise_signal, [number]).start()
        else:
            handler(number, frame)

    return handle


def _is_called_by_numba(frame: FrameType | None) -> bool:
    makes_results = getattr(sys.modules.get("numba.core.serialize"), "__file__", None)
    while frame is not None and frame.f_code.co_filename != makes_results:
        frame = frame.f_back
    return frame is not None

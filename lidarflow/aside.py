"""Work beside the thread that asks for it: two cores are rarely both busy with one kernel after the other."""

import contextlib
import itertools
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import ParamSpec, TypeVar

import numba

P = ParamSpec("P")
S = TypeVar("S")
T = TypeVar("T")

# Answers of a function to each of some items, in their order.
Each = Callable[[Callable[[S], T], Sequence[S]], list[T]]

# Numba's last resort, workqueue, aborts the process where two threads run kernels at once.
_THREADSAFE = ("omp", "tbb")


def _may_share_kernels() -> bool:
    """Whether kernels have threads for more than one caller, and may be run by two at once."""
    # Asking for their number launches them; before that, numba does not know the layer itself.
    return numba.get_num_threads() > 1 and numba.threading_layer() in _THREADSAFE


# Threads with nothing to do. A new one every time would bring new threads for its kernels, and memory of its
# own to each of them.
_idle: list[ThreadPoolExecutor] = []
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_idle.clear)     # a child has none of them


@contextlib.contextmanager
def _borrowed() -> Iterator[ThreadPoolExecutor]:
    """One thread, for the caller alone until it is given back."""
    try:
        thread = _idle.pop()
    except IndexError:
        thread = ThreadPoolExecutor(1, "lidarflow")
    try:
        yield thread
    finally:
        _idle.append(thread)


class Aside:
    """Does what it is given in the order given, in a thread of its own; leaving it waits for all of it.

    With one thread for kernels (NUMBA_NUM_THREADS=1) everything is done at once: the other cores are left to
    other processes. So it is where numba's threading layer is not known to be safe for two threads.
    """

    def __init__(self) -> None:
        self._lent = contextlib.ExitStack()
        self._thread: ThreadPoolExecutor | None = None
        self._last: Future | None = None

    def __enter__(self) -> "Aside":
        if _may_share_kernels():
            self._thread = self._lent.enter_context(_borrowed())
        return self

    def __exit__(self, *_error: object) -> None:
        if self._last is not None:
            wait([self._last])
        self._lent.close()
        self._thread = self._last = None     # another may have the thread by now

    def begin(self, function: Callable[P, T], *given: P.args, **named: P.kwargs) -> "Future[T]":
        """Begin a call; result() of what is returned waits for it, and raises what it raised."""
        if self._thread is None:
            return done(function, *given, **named)
        begun = self._last = self._thread.submit(function, *given, **named)
        return begun

    def each(self, function: Callable[[S], T], items: Sequence[S]) -> list[T]:
        """The function of each item, in their order; the other thread takes some when it comes to them.

        What the function raises is raised here, once nothing is under way.
        """
        answers: list = [None] * len(items)
        waiting = itertools.count()

        def take() -> None:
            while (number := next(waiting)) < len(items):
                answers[number] = function(items[number])

        begun = self.begin(take)
        try:
            take()
        finally:
            if not begun.cancel():     # it has begun to take some
                begun.result()
        return answers


def one_by_one(function: Callable[[S], T], items: Sequence[S]) -> list[T]:
    """As Aside.each, by the caller alone."""
    return [function(item) for item in items]


def done(function: Callable[P, T], *given: P.args, **named: P.kwargs) -> "Future[T]":
    """A call that is over when it is returned; what the function raises is raised here."""
    return there(function(*given, **named))


def there(value: T) -> "Future[T]":
    """The result of a call that was over long before."""
    known: Future[T] = Future()
    known.set_result(value)
    return known


@contextlib.contextmanager
def ahead(items: Iterator[T]) -> Iterator[Iterator[T]]:
    """`items`, the next of which is made while whoever asks uses the last; leaving waits for it.

    What making one raises is raised where it would have come. Where an Aside does everything at once, nothing
    is made before it is asked for.
    """
    if not _may_share_kernels():
        yield items
        return
    with Aside() as beside:
        yield _one_ahead(items, beside)


def _one_ahead(items: Iterator[T], beside: Aside) -> Iterator[T]:
    # Nothing is waited for at the end: a generator may be thrown away by any thread, by its own as well.
    end = object()
    begun = beside.begin(next, items, end)
    while (item := begun.result()) is not end:
        begun = beside.begin(next, items, end)
        yield item  # type: ignore[misc]

"""Work beside the thread that asks for it: two cores are rarely both busy with one kernel after the other."""

from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import ParamSpec, TypeVar

import numba

P = ParamSpec("P")
T = TypeVar("T")


class Aside:
    """Does what it is given in the order given, in a thread of its own; leaving it waits for all of it.

    With one thread for kernels (NUMBA_NUM_THREADS=1) everything is done at once: the other cores are left to
    other processes.
    """

    def __init__(self) -> None:
        self._thread = ThreadPoolExecutor(1, "lidarflow") if numba.get_num_threads() > 1 else None

    def __enter__(self) -> "Aside":
        return self

    def __exit__(self, *_error: object) -> None:
        if self._thread:
            self._thread.shutdown()

    def begin(self, function: Callable[P, T], *given: P.args, **named: P.kwargs) -> "Future[T]":
        """Begin a call; result() of what is returned waits for it, and raises what it raised."""
        if self._thread:
            return self._thread.submit(function, *given, **named)
        return done(function, *given, **named)


def done(function: Callable[P, T], *given: P.args, **named: P.kwargs) -> "Future[T]":
    """A call that is over when it is returned; what the function raises is raised here."""
    return there(function(*given, **named))


def there(value: T) -> "Future[T]":
    """The result of a call that was over long before."""
    known: Future[T] = Future()
    known.set_result(value)
    return known


def ahead(items: Iterator[T]) -> Iterator[T]:
    """`items`, the next of which is made while whoever asks uses the last.

    What making one raises is raised where it would have come. With one thread for kernels nothing is made
    before it is asked for.
    """
    if numba.get_num_threads() == 1:
        yield from items
        return
    end = object()
    with ThreadPoolExecutor(1, "lidarflow") as thread:
        begun = thread.submit(next, items, end)
        while (item := begun.result()) is not end:
            begun = thread.submit(next, items, end)
            yield item  # type: ignore[misc]

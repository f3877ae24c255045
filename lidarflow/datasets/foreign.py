"""Calling the packages of others: what they print, raise or exit with becomes one clear error."""

import contextlib
import io
import shlex
from collections.abc import Callable, Iterator
from typing import Any, Generic, TypeVar

from lidarflow.datasets.clouds import one_line
from lidarflow.errors import DataError, InstallError, LidarflowError

MAX_MESSAGE_CHARS = 300
_PACKAGES = {"mcap_ros2": "mcap-ros2-support", "nuscenes": "nuscenes-devkit", "ouster": "ouster-sdk>=1.0",
             "velodyne_decoder": "velodyne-decoder"}     # where module and package differ in name

T = TypeVar("T")


def guarded(origin: str, action: Callable[[], T]) -> T:
    """What `action` returns, in silence; `origin` says in messages what called it.

    Raises InstallError with the command that installs a missing package, and DataError for all else.
    """
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
        try:
            return action()
        except LidarflowError:
            raise
        except (Exception, SystemExit) as error:
            # Without its traceback, half-made objects go here and now, and what they print is caught too.
            failure = error.with_traceback(None)
            failure.__cause__ = failure.__context__ = None
    if isinstance(failure, ModuleNotFoundError):
        package = package_of(failure)
        raise InstallError(f"{origin} needs the package {package}; pip install {shlex.quote(package)}")
    said = " ".join(printed.getvalue().replace("--topic", "--sequence").replace("-" * 50, "").split())
    said = said[max(said.find("[ERROR]"), 0):]     # not what was said while all was well
    reason = f"{type(failure).__name__}: {one_line(failure)}"
    if isinstance(failure, SystemExit) and said:
        reason = said
    kind = InstallError if isinstance(failure, SystemExit) and "install" in said else DataError
    raise kind(f"{origin} failed ({reason[:MAX_MESSAGE_CHARS]})")


def package_of(error: ModuleNotFoundError) -> str:
    """The package on PyPI whose module is missing."""
    module = (error.name or "").partition(".")[0]
    return _PACKAGES.get(module, module)


class Stream(Generic[T]):
    """Items that can only be read forwards, by index: an earlier one is found by starting again.

    start  begins at item 0
    """

    def __init__(self, start: Callable[[], Iterator[T]]):
        self._start = start
        self._items: Iterator[T] = iter(())
        self._next = 0
        self._last: tuple[int, Any] = (-1, None)

    def item(self, index: int) -> T:
        """The item at `index`; IndexError where there are not so many."""
        if index == self._last[0]:
            return self._last[1]
        if index < self._next or self._next == 0:
            self._items, self._next = self._start(), 0
        while self._next <= index:
            item = next(self._items, _END)
            if item is _END:
                self._next = 0
                raise IndexError(f"no item {index}")
            self._last = self._next, item
            self._next += 1
        return self._last[1]


_END: Any = object()

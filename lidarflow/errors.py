"""Errors a user can act on: what was found, what was expected, what to do."""


_MOST_CHARS = 2000     # what damaged files are quoted with has no other end


class LidarflowError(Exception):
    """Any problem with data or settings; the command line shows it as one line and exits with 1."""

    def __str__(self) -> str:
        text = super().__str__()
        return text if len(text) <= _MOST_CHARS else f"{text[:_MOST_CHARS // 2]} … {text[-_MOST_CHARS // 2:]}"


class ConfigError(LidarflowError):
    """A setting is unknown, of the wrong type, or out of its range."""


class DataError(LidarflowError):
    """A file or a scan cannot be used as it is."""


class InputError(DataError, ValueError):
    """What a program hands over is no scan, frame or camera; also the ValueError that Python would raise."""


class OutOfRangeError(DataError, IndexError):
    """A data set has no scan or frame of this number; also the IndexError that Python would raise."""


class SolveError(LidarflowError):
    """The optimiser could not produce an answer for a well-formed problem."""


class InstallError(LidarflowError):
    """A package or a system library that lidarflow needs is missing."""

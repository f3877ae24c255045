"""Streams of the rerun viewer, into a recording or a window: opened, ended, checked and shown.

The only module that imports rerun; others have it from here, once the environment is as it should be.
"""

import errno
import os
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

# What rerun cannot write is seen by `close`, and said in one line.
os.environ.setdefault("RUST_LOG", "warn,re_log_encoding=off")
import rerun as rr
import rerun.blueprint as rrb

from lidarflow.errors import DataError, InstallError
from lidarflow.rgbd_types import RgbdPair
from lidarflow.silence import silenced
from lidarflow.types import ScanPair

FRAME, TIME = "frame", "time"

_EARLIEST_DATE_NS = 10**17  # 1973: smaller times count from the start of the drive
_FIRST = b"RRF"              # what a recording begins with, before the number of its format
_FOOTER = b"RRF2FOOT"        # what a recording ends with
_FOOTER_BYTES = 64
_PORT = 9876
_VIEWER_START_S = 20.0
_STALLED_S = 10.0             # a file that has not grown for so long will not grow any more

# Streams that a thread of rerun has stopped writing. Who ends them, or the program as usual, waits for ever.
stalled: list[rr.RecordingStream] = []


def open_stream(path: Path | None, application_id: str, spawn: bool,
                layout: rrb.Blueprint) -> rr.RecordingStream:
    """An empty stream with a `layout` to a file, a viewer it starts (`spawn`), or both."""
    if path is None and not spawn:
        raise ValueError("open_stream: give a path, spawn, or both")
    if spawn:
        _start_viewer()
    stream = rr.RecordingStream(application_id)
    try:
        sinks = [rr.FileSink(str(path))] if path is not None else []
        sinks += [rr.GrpcSink(f"rerun+http://127.0.0.1:{_PORT}/proxy")] if spawn else []
        stream.set_sinks(*sinks, default_blueprint=layout)
    except RuntimeError as error:
        raise DataError(f"{path}: the recording cannot be written ({error})") from None
    return stream


def close(stream: rr.RecordingStream, path: Path | None = None) -> None:
    """Write what is still buffered and end the recording; OSError where the file `path` lacks its end.

    Rerun writes in threads of its own, which only log that a disk is full, or end, or fall silent.
    """
    try:
        _flush(stream, path)
    except TimeoutError:
        stalled.append(stream)
        raise
    except RuntimeError as error:
        with silenced(2):   # it would log the same
            stream.disconnect()
        raise OSError(errno.EIO, f"the recording cannot be written, is the disk full? ({error})") from None
    stream.disconnect()
    if path is not None and not _ends_well(Path(path)):
        raise OSError(errno.EIO, "the end of the recording is missing, is the disk full?")


def _flush(stream: rr.RecordingStream, path: Path | None) -> None:
    """Write what is still buffered; TimeoutError, an OSError, where the file does not grow any more."""
    written = -1
    while True:
        begun = time.monotonic()
        try:
            return stream.flush(timeout_sec=_STALLED_S)
        except RuntimeError:
            size = path.stat().st_size if path is not None else written
            if time.monotonic() - begun < _STALLED_S / 2:
                raise
            if size <= written:
                raise TimeoutError(
                    errno.ETIMEDOUT, "the recording cannot be written, is the disk full?") from None
            written = size


def _ends_well(path: Path) -> bool:
    with path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - _FOOTER_BYTES))
        return _FOOTER in file.read()


def check_recording(path: Path) -> None:
    """Raise DataError unless a file begins as recordings do."""
    with Path(path).open("rb") as file:
        first = file.read(len(_FIRST) + 1)
    if not first.startswith(_FIRST):
        raise DataError(f"{path}: not a recording, it begins with {first!r}; expected an .rrd file of rerun, "
                        "such as 'lidarflow run' and 'lidarflow view --save' write")


def open_in_viewer(rrd_path: Path) -> None:
    """Show a recording in the rerun viewer and wait until its window is closed."""
    if not Path(rrd_path).is_file():
        raise DataError(f"{rrd_path}: no such recording")
    require_display(f"copy {rrd_path} to a desktop, or view it in a browser: rerun --web-viewer {rrd_path}")
    if subprocess.run([sys.executable, "-m", "rerun", str(rrd_path)], check=False).returncode != 0:
        raise InstallError(f"the rerun viewer failed; in a browser: rerun --web-viewer {rrd_path}")


def all_until_now() -> rrb.VisibleTimeRanges:
    """Show every frame logged up to the time cursor, on either timeline."""
    return rrb.VisibleTimeRanges([
        rrb.VisibleTimeRange(FRAME, start=rrb.TimeRangeBoundary.infinite(),
                             end=rrb.TimeRangeBoundary.cursor_relative(seq=0)),
        rrb.VisibleTimeRange(TIME, start=rrb.TimeRangeBoundary.infinite(),
                             end=rrb.TimeRangeBoundary.cursor_relative(seconds=0))])


def set_times(stream: rr.RecordingStream, index: int, pair: ScanPair | RgbdPair) -> None:
    """The frame, and the time where the scans have one: a date if it counts from 1970, else a duration."""
    stream.set_time(FRAME, sequence=index)
    if pair.target.time_ns <= pair.source.time_ns:
        return
    if pair.source.time_ns > _EARLIEST_DATE_NS:
        stream.set_time(TIME, timestamp=np.datetime64(pair.source.time_ns, "ns"))
    else:
        stream.set_time(TIME, duration=np.timedelta64(pair.source.time_ns, "ns"))


def require_live_view() -> None:
    """Raise InstallError unless a viewer listens already or one can be opened here."""
    if not _viewer_listens():
        require_display()


def require_display(instead: str = "") -> None:
    """Raise InstallError where no window can be opened; `instead` is the command that needs none."""
    displays = ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET")
    if sys.platform.startswith("linux") and not any(os.environ.get(name) for name in displays):
        way_out = instead or "leave --visualize out and view the recording on a desktop"
        raise InstallError(f"the rerun viewer needs a display and this session has none; {way_out}")


def _start_viewer() -> None:
    """Start a viewer that outlives this process, unless one listens already; return when it is ready."""
    if _viewer_listens():
        return
    require_display()
    viewer = subprocess.Popen([sys.executable, "-m", "rerun", "--port", str(_PORT), "--hide-welcome-screen"],
                              stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True)
    deadline = time.monotonic() + _VIEWER_START_S
    while not _viewer_listens():
        if viewer.poll() is not None or time.monotonic() > deadline:
            raise InstallError("the rerun viewer did not start; run `rerun` by itself to see why")
        time.sleep(0.1)


def _viewer_listens() -> bool:
    try:
        socket.create_connection(("127.0.0.1", _PORT), timeout=0.5).close()
    except OSError:
        return False
    return True

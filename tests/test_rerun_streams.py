import os
import time

import pytest

from lidarflow import rerun_streams, viewer
from lidarflow.errors import DataError, InstallError


def test_no_display_is_one_clear_line(tmp_path, monkeypatch):
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(rerun_streams.sys, "platform", "linux")
    monkeypatch.setattr(rerun_streams, "_viewer_listens", lambda: False)
    path = tmp_path / "empty.rrd"
    path.touch()
    for attempt in (lambda: rerun_streams.open_in_viewer(path),
                    lambda: viewer.open_recording(None, spawn=True)):
        with pytest.raises(InstallError, match="display") as caught:
            attempt()
        assert "\n" not in str(caught.value)


def test_paths_that_cannot_be_used_are_data_errors(tmp_path):
    with pytest.raises(DataError, match=r"nowhere"):
        viewer.open_recording(tmp_path / "nowhere" / "recording.rrd")
    with pytest.raises(DataError, match="no such recording"):
        rerun_streams.open_in_viewer(tmp_path / "absent.rrd")
    with pytest.raises(ValueError, match="path"):
        viewer.open_recording(None)


class Ended:
    """A stream whose writer has ended, as when the disk is full; it says so once more when it is let go."""

    def flush(self, timeout_sec):
        raise RuntimeError("writer ended")

    def disconnect(self):
        os.write(2, b"writer ended\n")


def test_a_recording_that_cannot_be_ended_is_one_error(capfd):
    with pytest.raises(OSError, match="is the disk full"):
        rerun_streams.close(Ended())
    assert capfd.readouterr().err == ""


class Silent:
    """A stream whose writer does not answer any more; ending it would wait for ever."""

    def __init__(self, path, grows):
        self.path, self.grows = path, grows

    def flush(self, timeout_sec):
        time.sleep(timeout_sec)
        if self.grows:
            self.grows -= 1
            with self.path.open("ab") as file:
                file.write(b"more")
        raise RuntimeError("timed out")


@pytest.mark.parametrize("grows", [0, 2])
def test_a_recording_that_grows_no_more_is_given_up(tmp_path, monkeypatch, grows):
    monkeypatch.setattr(rerun_streams, "_STALLED_S", 0.05)
    monkeypatch.setattr(rerun_streams, "stalled", [])
    (tmp_path / "a.rrd").touch()
    stream = Silent(tmp_path / "a.rrd", grows)
    with pytest.raises(TimeoutError, match="is the disk full"):
        rerun_streams.close(stream, tmp_path / "a.rrd")
    assert rerun_streams.stalled == [stream] and stream.grows == 0

"""Where the real recordings are that some tests use, and the mark that skips these tests without them."""

import os
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
SHARED = Path(os.environ.get("LIDARFLOW_DATA", ROOT.parent / "shared" / "data"))

needs_shared = pytest.mark.skipif(
    not SHARED.is_dir(),
    reason="real recordings are not here: set LIDARFLOW_DATA to the folder that holds them")

"""Where the project and the real recordings for tests are, and the mark that skips without these."""

import os
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
SHARED = Path(os.environ.get("LIDARFLOW_DATA", ROOT.parent / "shared" / "data"))


def with_paths(*folders):
    """The environment, for programs of their own that import this project and what is in more folders."""
    paths = [ROOT, *folders, os.environ.get("PYTHONPATH", "")]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, paths))}


needs_shared = pytest.mark.skipif(
    not SHARED.is_dir(),
    reason="real recordings are not here: set LIDARFLOW_DATA to the folder that holds them")

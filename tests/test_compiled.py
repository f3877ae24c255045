"""The cache of compiled kernels: it knows all sources; read-only installs and two first users are served."""

import os
import subprocess
import sys
from pathlib import Path

import numba
import numpy as np
import pytest

from lidarflow.kernels import compiled, graphs

USE = """
import numpy as np
from lidarflow.kernels import compiled, graphs
print(compiled.are_cached())
print(graphs.components(np.array([[0, 2]], np.int32), 4).tolist())
print(compiled.are_cached())
"""


@pytest.fixture
def package(tmp_path) -> Path:
    folder = tmp_path / "kernels"
    folder.mkdir()
    (folder / "a.py").write_text("1")
    (folder / "b.py").write_text("2")
    return folder


def test_another_source_has_another_cache(package):
    before = compiled.cache_folder(package, "")
    assert before == compiled.cache_folder(package, "") and before.parent == package / "__pycache__"
    (package / "b.py").write_text("3")
    assert compiled.cache_folder(package, "") != before


def test_another_numba_has_another_cache(package, monkeypatch):
    before = compiled.cache_folder(package, "")
    monkeypatch.setattr(numba, "__version__", "0.1")
    assert compiled.cache_folder(package, "") != before


def test_a_wanted_folder_is_used(package, tmp_path):
    assert compiled.cache_folder(package, str(tmp_path / "mine")).parent == tmp_path / "mine"
    assert not (package / "__pycache__").exists()


def test_an_install_that_cannot_be_written_is_cached_with_the_user(package, monkeypatch, tmp_path):
    (package / "__pycache__").write_text("a file, so that no folder can be made")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home"))
    found = compiled.cache_folder(package, "")
    assert package not in found.parents and found.name.startswith("lidarflow-")


@pytest.mark.parametrize(("asked", "found"), [(None, "passive"), ("active", "active")])
def test_threads_do_not_spin_while_they_wait_unless_the_user_wants_it(asked, found):
    environment = {name: value for name, value in os.environ.items() if name != "OMP_WAIT_POLICY"}
    if asked is not None:
        environment["OMP_WAIT_POLICY"] = asked
    program = "import os; from lidarflow.kernels import compiled; print(os.environ['OMP_WAIT_POLICY'])"
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True,
                          check=True)
    assert done.stdout.strip() == found


def test_kernels_are_cached_there_and_nothing_else_is():
    graphs.components(np.array([[0, 1]], np.int32), 2)
    assert compiled.are_cached()
    assert str(compiled.FOLDER) != numba.config.CACHE_DIR
    assert graphs._components.stats.cache_path.startswith(str(compiled.FOLDER))


def test_two_first_users_at_once_both_succeed_and_the_next_finds_the_cache(tmp_path):
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}

    def start() -> subprocess.Popen:
        return subprocess.Popen(
            [sys.executable, "-c", USE], env=environment, text=True, stdout=subprocess.PIPE,
            stderr=subprocess.PIPE, cwd=Path(__file__).parent)

    both = [start(), start()]
    for process in both:
        told, trouble = process.communicate(timeout=120)
        assert process.returncode == 0, trouble
        assert told.splitlines()[1:] == ["[0, 1, 0, 2]", "True"]
    told, _ = start().communicate(timeout=120)
    assert told.splitlines() == ["True", "[0, 1, 0, 2]", "True"]

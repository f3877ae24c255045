"""The wheel that is built from the tree works where nothing of the tree is: in an environment of its own."""

import json
import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from shared_data import ROOT

from lidarflow import __version__, first_use

pytestmark = pytest.mark.slow

# What the tests' own environment must not lend to the new one, and what makes a display.
HIDDEN = ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV", "NUMBA_CACHE_DIR", "DISPLAY", "WAYLAND_DISPLAY",
          "WAYLAND_SOCKET")
RUN_FILES = {"config.toml", "flow", "metrics.json", "objects.csv", "poses_kitti.txt", "poses_tum.txt",
             "preview.png", "recording.rrd", "source.json", "timing.json"}


def ran(*words, cwd, timeout_s=300):
    """The finished process of a command that sees nothing of this environment and has no display."""
    environment = {name: value for name, value in os.environ.items() if name not in HIDDEN}
    return subprocess.run([str(word) for word in words], cwd=cwd, capture_output=True, text=True,
                          timeout=timeout_s, env=environment | {"COLUMNS": "80"}, check=False)


def output_of(*words, cwd, timeout_s=300):
    """What a command that must work writes to stdout."""
    done = ran(*words, cwd=cwd, timeout_s=timeout_s)
    assert done.returncode == 0, f"{words}: {done.stdout[-2000:]}{done.stderr[-2000:]}"
    return done.stdout


def package_files(folder):
    """Names of the files of the package in `folder`, without what running it leaves there."""
    return {file.relative_to(folder).as_posix() for file in (folder / "lidarflow").rglob("*")
            if file.is_file() and "__pycache__" not in file.parts}


@pytest.fixture(scope="module")
def python(tmp_path_factory):
    """The Python of an empty environment outside the tree; the test is skipped where no registry answers."""
    place = tmp_path_factory.mktemp("environment")
    output_of(sys.executable, "-m", "venv", place / "venv", cwd=place)
    python = place / "venv" / "bin" / "python"
    probe = ran(python, "-m", "pip", "--timeout", 5, "--retries", 0, "download", "--quiet", "--no-cache-dir",
                "--no-deps", "--dest", place, "hatchling", cwd=place)
    if probe.returncode:
        reason = (probe.stderr.strip().splitlines() or ["pip does not work"])[-1]
        pytest.skip(f"no package registry answers: {reason}")
    return python


@pytest.fixture(scope="module")
def wheel(python, tmp_path_factory):
    """The wheel of a clean copy of what it is made of."""
    place = tmp_path_factory.mktemp("wheel")
    tree = place / "tree"
    shutil.copytree(ROOT / "lidarflow", tree / "lidarflow", ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, tree)
    output_of(python, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", place, tree, cwd=place)
    file, = place.glob("*.whl")
    return file


@pytest.fixture(scope="module")
def lidarflow(python, wheel):
    """The installed program, which must find all that it needs among what the wheel asks for."""
    output_of(python, "-m", "pip", "install", "--quiet", "--no-compile", wheel, cwd=wheel.parent,
              timeout_s=900)
    assert "No broken requirements" in output_of(python, "-m", "pip", "check", cwd=wheel.parent)
    return python.parent / "lidarflow"


def test_the_wheel_holds_the_package_and_its_data(wheel):
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    held = {name for name in names if not name.split("/")[0].endswith(".dist-info")}
    assert held == package_files(ROOT)
    assert held > {"lidarflow/py.typed", "lidarflow/report/templates/page.html"}
    assert any(name.endswith("licenses/LICENSE") for name in names)


def test_the_installed_program_answers(lidarflow, tmp_path):
    assert output_of(lidarflow, "--version", cwd=tmp_path) == f"lidarflow {__version__}\n"
    assert "Dense rigid scene flow" in output_of(lidarflow, "--help", cwd=tmp_path)
    assert "solver.method" in output_of(lidarflow, "config", cwd=tmp_path)
    where = output_of(lidarflow.with_name("python"), "-c", "import lidarflow; print(lidarflow.__file__)",
                      cwd=tmp_path)
    assert Path(where.strip()).is_relative_to(lidarflow.parents[1]), "the tree is not what was imported"
    refused = ran(lidarflow, "run", "nowhere", "--out", "run", cwd=tmp_path)
    assert refused.returncode == 1 and refused.stderr.startswith("lidarflow: nowhere: ")
    assert not list(tmp_path.iterdir())


def test_the_demo_runs_in_an_empty_folder_without_a_display(lidarflow, tmp_path):
    done = ran(lidarflow, "demo", cwd=tmp_path, timeout_s=600)
    assert (done.returncode, done.stderr) == (0, first_use.LINE + "\n"), done.stdout + done.stderr
    run = tmp_path / "demo" / "run"
    assert {file.name for file in tmp_path.iterdir()} == {"demo"}
    assert {file.name for file in run.iterdir()} == RUN_FILES
    assert [file.name for file in sorted((run / "flow").iterdir())] == [f"00000{k}.npz" for k in range(4)]
    assert (run / "preview.png").read_bytes().startswith(b"\x89PNG")
    mean = json.loads((run / "metrics.json").read_text(encoding="utf-8"))["mean"]
    # The README's figures for such a street, with room for other versions of what it rests on.
    assert mean["epe_static_m"] < 0.01 and mean["epe_dynamic_m"] < 0.15 and mean["movers_found"] > 0.85
    assert f"{mean['epe_static_m']:.3f}" in done.stdout
    page = tmp_path / "report.html"
    output_of(lidarflow, "report", run, "--out", page, cwd=tmp_path)
    assert page.stat().st_size > 100_000 and "000003" in page.read_text(encoding="utf-8")

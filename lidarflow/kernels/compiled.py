"""How kernels are compiled: once, into a cache that knows the sources of all of them.

numba's cache watches a function's own file only: after an update it would go on using code with other files'
old functions inside, and two versions of numba that share a cache make each other compile anew every time.
The cache therefore has a folder for each state of the sources and version of numba.

Kernels that Python calls return plain tuples: a named one is made by Python, which looks for signals then, so
that Ctrl-C would crash the process.
"""

import hashlib
import os
import tempfile
from pathlib import Path

import numba
import platformdirs

# TBB where it is too old makes numba warn on every start; OpenMP is as fast here.
numba.config.THREADING_LAYER_PRIORITY = ["omp", "tbb", "workqueue"]
# OpenMP reads it when it is loaded. Threads that spin while they wait for one another keep the cores from
# those they wait for as soon as anything else runs: beside another program kernels take many times as long.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")


def cache_folder(package: Path, wanted: str) -> Path:
    """Where kernels of `package` are cached: in the `wanted` folder, beside them, or with the user's caches.

    An installation may be read-only; `wanted` is what NUMBA_CACHE_DIR says, or empty.
    """
    digest = hashlib.sha256(numba.__version__.encode())
    for source in sorted(package.glob("*.py")):
        digest.update(source.read_bytes())
    state = f"lidarflow-{digest.hexdigest()[:16]}"
    if wanted:
        return Path(wanted) / state
    beside = package / "__pycache__" / state
    return beside if _is_writable(beside) else Path(platformdirs.user_cache_dir("lidarflow")) / state


def _is_writable(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError:
        return False
    return True


FOLDER = cache_folder(Path(__file__).parent, numba.config.CACHE_DIR)
# For arithmetic: numbers are divided as in numpy, and products are added up without being rounded first.
FUSED = {"error_model": "numpy", "fastmath": {"contract"}}


def njit(**options):
    """numba.njit with `options`, cached in FOLDER and free of the interpreter lock.

    Caches of other packages stay where they are.
    """

    def compiled(function):
        elsewhere, numba.config.CACHE_DIR = numba.config.CACHE_DIR, str(FOLDER)
        try:
            return numba.njit(cache=True, nogil=True, **options)(function)
        finally:
            numba.config.CACHE_DIR = elsewhere

    return compiled


def are_cached() -> bool:
    """Whether kernels of this state have been compiled on this machine before."""
    return next(FOLDER.rglob("*.nbi"), None) is not None

"""The masks of Argoverse 2's challenge of 2023: the sweeps and points that a submission must answer for.

An archive (.zip) of <log>/<time_ns>.feather, whose column "mask" has a row for every point of the sweep.
"""

import zipfile
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import numpy as np

from lidarflow.datasets import arrays
from lidarflow.datasets.argoverse2 import columns_of
from lidarflow.errors import DataError


@dataclass(frozen=True, slots=True)
class Masks:
    """The masks of one log.

    times_ns  frozenset of int   of the sweeps that there is a mask of
    """

    archive: Path
    log: str
    times_ns: frozenset[int]

    @classmethod
    def find(cls, archive: Path, log: str) -> "Masks":
        """The masks of `log` in an archive; DataError where it is none, or has none of this log."""
        try:
            with zipfile.ZipFile(archive) as opened:
                names = opened.namelist()
        except (OSError, zipfile.BadZipFile, ValueError, RuntimeError) as error:
            reason = getattr(error, "strerror", None) or error
            raise DataError(f"--masks {archive}: not a readable archive ({reason}); expected the .zip of "
                            "masks that the challenge offers") from None
        stems = [name.removeprefix(f"{log}/").removesuffix(".feather") for name in names
                 if name.startswith(f"{log}/") and name.endswith(".feather")]
        times_ns = frozenset(int(stem) for stem in stems if stem.isdecimal())
        if not times_ns:
            raise DataError(f"--masks {archive}: no masks of the log {log}; expected "
                            f"{log}/<time_ns>.feather, are they those of another split?")
        return cls(Path(archive), log, times_ns)

    def of(self, time_ns: int, points: int) -> np.ndarray:
        """Which of the `points` of a sweep the challenge counts: (points,) bool; DataError where damaged."""
        name = f"{self.log}/{time_ns}.feather"
        place = f"--masks {self.archive}: {name}"
        try:
            with zipfile.ZipFile(self.archive) as opened:
                arrays.check_unpacked(opened.getinfo(name))
                content = opened.read(name)
        except arrays.ERRORS as error:
            raise DataError(f"{place}: damaged ({error}); get the archive again") from None
        mask = columns_of(BytesIO(content), place, ("mask",))["mask"]
        if mask.shape != (points,) or mask.dtype != bool:
            raise DataError(f"{place}: {len(mask)} rows of {mask.dtype}; expected bool, a row for each of "
                            f"the {points} points of the sweep")
        return mask

"""Whether a run folder holds the beginning of the run that is asked for, or all of it."""

import json
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

from lidarflow import io, provenance, run_folder
from lidarflow.config import Config, load
from lidarflow.datasets.rgbd_folders import RgbdSource
from lidarflow.errors import DataError
from lidarflow.provenance import RunSource
from lidarflow.rgbd_config import RgbdConfig
from lidarflow.settings import to_dict

_NAMED = 3                     # how many settings a message shows


class State(Enum):
    """How far a run has come."""

    NEW = "new"
    BEGUN = "begun"
    COMPLETE = "complete"


@dataclass(frozen=True, slots=True)
class Plan:
    """What decides the bytes of a run: a data set and its scans, settings, method.

    chunk  pairs that are computed on their own, by several processes; 0 = all in one go
    """

    source: RunSource
    config: Config | RgbdConfig
    method: str
    chunk: int = 0

    @property
    def comment(self) -> str:
        """What config.toml begins with."""
        return f"Method: {self.method}" + (f", in chunks of {self.chunk} pairs" if self.chunk else "")


def begin(out: Path, plan: Plan) -> None:
    """Make `out` ready for a run from its start; what an earlier run left there is removed."""
    run_folder.make(out)
    io.write_toml(out / io.CONFIG_FILE, plan.config, plan.comment)
    provenance.write(out, plan.source)


def state_of(out: Path, plan: Plan) -> State:
    """How far the run that `plan` describes has come in `out`.

    Raises DataError where `out` holds another run: of other data, other settings, another method, or in other
    chunks.
    """
    begun = any((out / io.RESUME_FOLDER).rglob("*.npz"))
    if not begun and not (out / io.TIMING_FILE).is_file():
        return State.NEW
    if not (out / io.CONFIG_FILE).is_file():
        raise DataError(f"--resume: {out} has no {io.CONFIG_FILE}, so what it was made with is unknown; "
                        "run without --resume to begin anew")
    differs = _difference(out, plan)
    if differs:
        raise DataError(f"--resume: {out} was made {differs}; ask for the same, or run without --resume to "
                        "begin anew")
    return State.BEGUN if begun else State.COMPLETE


def damaged_files(out: Path) -> list[str]:
    """Names in a complete run's folder of what other commands need and is missing, or cut off."""
    try:
        frames = list(json.loads((out / io.TIMING_FILE).read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError, RecursionError):
        return [io.TIMING_FILE]
    flows = [f"{io.FLOW_FOLDER}/{frame}.npz" for frame in frames]
    damaged = [name for name in flows if not io.is_whole(out / name)]
    return damaged if (out / "poses_tum.txt").is_file() else [*damaged, "poses_tum.txt"]


def _difference(out: Path, plan: Plan) -> str:
    """What a run in `out` was made of that `plan` does not ask for; "" for nothing."""
    made_of = provenance.read_any(out)
    if made_of.dataset != plan.source.dataset:
        return f"from {_place(made_of)}, not from {_place(plan.source)}"
    if made_of.scans != plan.source.scans:
        return f"from scans {_span(made_of.scans)}, not {_span(plan.source.scans)}"
    if (out / io.CONFIG_FILE).read_text(encoding="utf-8") == io.as_toml(plan.config, plan.comment):
        return ""
    used, wanted = to_dict(load(out / io.CONFIG_FILE, (), type(plan.config))), to_dict(plan.config)
    settings = [f"{section}.{name} = {value}, not {wanted[section][name]}"
                for section, values in used.items() for name, value in values.items()
                if value != wanted[section][name]]
    if settings:
        return "with " + "; ".join(settings[:_NAMED])
    heading = (out / io.CONFIG_FILE).read_text(encoding="utf-8").partition("\n")[0].removeprefix("# ")
    return f"with other settings ({heading}), not ({plan.comment})"


def _place(source: RunSource) -> str:
    opened = source.dataset
    if opened is None:
        return "scans that are not in a folder"
    if isinstance(opened, RgbdSource):
        return f"{opened.folder} (RGB-D, {opened.camera}, depth scale {opened.depth_scale:g})"
    sequence = f", sequence {opened.sequence}" if opened.sequence is not None else ""
    return f"{opened.folder} ({opened.loader}{sequence}, kitti_correction {opened.kitti_correction})"


def _span(scans: tuple[int, ...]) -> str:
    return f"{scans[0]} to {scans[-1]}"

"""The files that Argoverse 2's scene flow challenges take: <log>/<time_ns>.feather, a row per point.

v1 (2023)  flow_tx_m, flow_ty_m, flow_tz_m of the total flow, is_dynamic
v2 (2024)  is_valid, and the flow that points do by themselves: ego-motion removed
v3         that flow alone

Flow is float16, in the axes of the target's frame. What is not known of a NaN point is NaN, and not valid.
v1 wants the sweeps and points of the official masks alone; the others want every point.
"""

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from lidarflow.errors import DataError, InstallError
from lidarflow.export.argoverse2_masks import Masks
from lidarflow.export.finished_run import FinishedRun, scene_name
from lidarflow.flow_files import FlowFile
from lidarflow.io import written_aside

COLUMNS = ("flow_tx_m", "flow_ty_m", "flow_tz_m")


def write_v1(run: FinishedRun, out: Path, masks: Path | None = None) -> Iterator[Path]:
    """Total flow, and which points move over ground: of all points, or those in an archive of `masks`.

    With masks, files are those of a submission. DataError where the run lacks a sweep that they count.
    """
    return _write(run, out, lambda found: {
        **_flow_columns(found.flow), "is_dynamic": found.is_dynamic}, masks)


def write_v2(run: FinishedRun, out: Path) -> Iterator[Path]:
    """Which rows have an answer, and the flow without ego-motion."""
    return _write(run, out, lambda found: {
        "is_valid": np.isfinite(found.flow).all(axis=1), **_flow_columns(_residual_flow(found))})


def write_v3(run: FinishedRun, out: Path) -> Iterator[Path]:
    """The flow without ego-motion."""
    return _write(run, out, lambda found: _flow_columns(_residual_flow(found)))


def _write(
    run: FinishedRun, out: Path, columns_of: Callable[[FlowFile], dict[str, np.ndarray]],
    masks: Path | None = None,
) -> Iterator[Path]:
    try:
        import pyarrow
        from pyarrow import feather
    except ImportError:
        raise InstallError(f"{out}: .feather needs the package pyarrow; pip install pyarrow") from None
    log = scene_name(run.dataset())
    counted = None if masks is None else _counted(run, Masks.find(masks, log))
    files = []
    with contextlib.ExitStack() as written:     # all files or none
        for number, _, found in run.pairs():
            time_ns = int(run.times_ns[number])
            columns = columns_of(found)
            if counted is not None:
                if time_ns not in counted.times_ns:
                    continue
                mask = counted.of(time_ns, len(found.points))
                columns = {name: values[mask] for name, values in columns.items()}
            files.append(out / log / f"{time_ns}.feather")
            aside = written.enter_context(written_aside(files[-1]))
            feather.write_feather(pyarrow.table(columns), str(aside))
    yield from files


def _counted(run: FinishedRun, masks: Masks) -> Masks:
    """`masks`; DataError where they count a sweep that the run has no flow of."""
    lacking = sorted(masks.times_ns - set(run.times_ns[run.sources()].tolist()))
    if lacking:
        raise DataError(f"{run.folder}: no flow of {len(lacking)} of the {len(masks.times_ns)} sweeps that "
                        f"{masks.archive} counts, {lacking[0]} is the first; run over the whole log")
    return masks


def _flow_columns(flow: np.ndarray) -> dict[str, np.ndarray]:
    """The columns of a flow (N, 3) in metres."""
    return {name: flow[:, axis].astype(np.float16) for axis, name in enumerate(COLUMNS)}


def _residual_flow(found: FlowFile) -> np.ndarray:
    return found.result().residual_flow(found.points.astype(np.float64))

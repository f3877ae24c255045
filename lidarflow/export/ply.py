"""Clouds to look at, <scan>.ply: points in the colours of the viewer, with their flow.

A vertex has x, y, z (metres, sensor frame), red, green, blue (motion over ground: hue is its direction,
saturation the speed), flow_x, flow_y, flow_z (metres, total) and object (-1 = none). Binary, little endian;
points that are not finite are left out.
"""

import contextlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from lidarflow import colour, pose
from lidarflow.export.finished_run import FinishedRun
from lidarflow.flow_files import FlowFile
from lidarflow.io import written_aside

_VERTEX = np.dtype([
    *((axis, "<f4") for axis in "xyz"), *((channel, "u1") for channel in ("red", "green", "blue")),
    *((f"flow_{axis}", "<f4") for axis in "xyz"), ("object", "<i4")])
_PLY_TYPES = {"<f4": "float", "|u1": "uchar", "<i4": "int"}


def write(run: FinishedRun, out: Path) -> Iterator[Path]:
    """One file per pair, named as its source scan; all of them or none."""
    files = []
    with contextlib.ExitStack() as written:
        for number, name, found in run.pairs():
            files.append(out / f"{name}.ply")
            vertices = vertices_of(found, run.dt_s(number))
            aside = written.enter_context(written_aside(files[-1]))
            aside.write_bytes(_header(len(vertices)) + vertices.tobytes())
    yield from files


def vertices_of(found: FlowFile, dt_s: float) -> np.ndarray:
    """A table with the fields of a vertex for every finite point, `dt_s` seconds to the target."""
    points, flow = found.points.astype(np.float64), found.flow.astype(np.float64)
    # Arrows and colours are seen from the source, as in the viewer.
    residual_flow = pose.apply(pose.inverse(found.ego_motion), points + flow) - points
    moving = found.is_dynamic & np.isfinite(residual_flow).all(axis=1)
    colours = colour.scene_colours(points, residual_flow, moving, dt_s)
    known = np.isfinite(points).all(axis=1)
    vertices = np.empty(known.sum(), _VERTEX)
    for names, columns in ((("x", "y", "z"), found.points), (("red", "green", "blue"), colours),
                           (("flow_x", "flow_y", "flow_z"), found.flow)):
        for name, column in zip(names, columns.T, strict=True):
            vertices[name] = column[known]
    vertices["object"] = found.object_id[known]
    return vertices


def _header(count: int) -> bytes:
    properties = [f"property {_PLY_TYPES[_VERTEX[name].str]} {name}" for name in _VERTEX.names]
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {count}", *properties, "end_header"]
    return ("\n".join(lines) + "\n").encode("ascii")

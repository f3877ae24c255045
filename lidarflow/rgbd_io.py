"""Flow files of RGB-D pairs."""

import json
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from lidarflow import io, pose, settings
from lidarflow.errors import DataError
from lidarflow.rgbd_config import RgbdConfig
from lidarflow.rgbd_types import Camera, RgbdFrame, RgbdResult

# name: shape, with H and W of the image and K of the clusters; dtype kind
_ARRAYS = {
    "flow": ("HW3", "f"), "valid": ("HW", "b"), "points": ("HW3", "f"), "label": ("HW", "i"),
    "is_dynamic": ("HW", "b"), "color": ("HW3", "u"), "b": ("K", "f"), "centres": ("K3", "f"),
    "cluster_motions": ("K44", "f"), "odometry": ("44", "f"), "camera": ("6", "f"), "config": ("", "U"),
    "stats": ("", "U"),
}
_MARK = "cluster_motions"
# arrays of RgbdResult that flow files and checkpoints hold under their own names
RESULT_ARRAYS = (
    "flow", "points", "valid", "label", "b", "cluster_motions", "odometry", "is_dynamic", "centres")


@dataclass(frozen=True, slots=True, eq=False)
class RgbdFlowFile:
    """What a flow file of a pair holds.

    result  RgbdResult          without its wall times
    color   (H, W, 3) uint8     the source's colours at the result's size
    config  dict                the settings it was made with
    stats   dict                method, share of moving pixels, change of exposure, residuals
    """

    result: RgbdResult
    color: np.ndarray
    config: dict
    stats: dict


def save_flow(path: Path, source: RgbdFrame, result: RgbdResult, config: RgbdConfig, stats: dict) -> None:
    """Write a flow file (.npz) of a pair's `source` and `result`; the same input gives the same bytes."""
    camera = result.camera
    arrays = {
        "flow": result.flow.astype(np.float32), "valid": result.valid,
        "points": result.points.astype(np.float32), "label": result.label.astype(np.int32),
        "is_dynamic": result.is_dynamic, "color": color_at(source, camera.width, camera.height),
        "b": result.b.astype(np.float64), "centres": result.centres.astype(np.float32),
        "cluster_motions": result.cluster_motions.astype(np.float64),
        "odometry": result.odometry.astype(np.float64),
        "camera": camera_row(camera),
        "config": np.array(io.as_json(settings.to_dict(config))), "stats": np.array(io.as_json(stats)),
    }
    with io.written_aside(path) as aside:
        aside.write_bytes(io.archive(arrays))


def load_flow(path: Path) -> RgbdFlowFile:
    """Read a flow file of an RGB-D pair; DataError where it is damaged, or not such a file."""
    arrays = io.read_archive(Path(path), tuple(_ARRAYS))
    sizes = dict(zip("HW", arrays["flow"].shape, strict=False))
    sizes |= dict(zip("K", arrays["b"].shape, strict=False))
    for name, (shape, kind) in _ARRAYS.items():
        expected = tuple(int(axis) if axis.isdigit() else sizes.get(axis, 0) for axis in shape)
        if arrays[name].shape != expected or arrays[name].dtype.kind != kind:
            raise DataError(f"{path}: '{name}' is {arrays[name].shape} of {arrays[name].dtype}; expected "
                            f"{expected} of the kind that lidarflow writes")
    try:
        found = {name: json.loads(str(arrays[name])) for name in ("config", "stats")}
        result = RgbdResult(
            **{name: arrays[name] for name in RESULT_ARRAYS}, camera=camera_of(arrays["camera"]))
        if not all(isinstance(value, dict) for value in found.values()):
            raise ValueError("config and stats are no tables")
        if not pose.is_rigid(result.cluster_motions, 1e-4):
            raise ValueError("its cluster motions are not rigid")
    except (ValueError, OverflowError, RecursionError) as error:
        reason = " ".join(str(error).split())
        raise DataError(f"{path}: damaged flow file ({reason})") from None
    return RgbdFlowFile(result, arrays["color"], found["config"], found["stats"])


def is_rgbd_flow(path: Path) -> bool:
    """Whether a file is a flow file of an RGB-D pair, as far as its table of contents tells."""
    try:
        with zipfile.ZipFile(path) as archive:
            return f"{_MARK}.npy" in archive.namelist()
    except (OSError, zipfile.BadZipFile):
        return False


def camera_row(camera: Camera) -> np.ndarray:
    """Width, height, fx, fy, cx, cy in pixels as (6,) float64."""
    return np.array([camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy])


def camera_of(row: np.ndarray) -> Camera:
    """The camera that `camera_row` made `row` of; ValueError or OverflowError where there is none."""
    width, height, *intrinsics = row.tolist()
    return Camera(int(width), int(height), *intrinsics)


def color_at(frame: RgbdFrame, width: int, height: int) -> np.ndarray:
    """RGB (height, width, 3) uint8 of a frame, of its intensity where it has no colours."""
    grey = np.round(255.0 * frame.intensity).astype(np.uint8)
    image = Image.fromarray(np.repeat(grey[..., None], 3, axis=2) if frame.color is None else frame.color)
    return np.asarray(image.resize((width, height), Image.Resampling.BOX))

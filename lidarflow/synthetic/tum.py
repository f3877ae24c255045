"""Rendered RGB-D sequences as a folder of the TUM RGB-D benchmark, with the truth beside the images."""

from dataclasses import asdict
from pathlib import Path

import numpy as np
import tomli_w
from PIL import Image

from lidarflow import pose
from lidarflow.errors import DataError
from lidarflow.rgbd_types import Camera, RgbdFrame, RgbdTruth

DEPTH_PER_METRE = 5000.0
_HEADER = "# written by lidarflow\n# timestamp {}\n"


def write_tum(folder: Path, sequence: list[tuple[RgbdFrame, RgbdTruth | None]], camera: Camera) -> None:
    """Write a sequence in the TUM RGB-D layout into a new or empty folder.

    rgb/<seconds>.png, depth/<seconds>.png   8-bit colour, 16-bit depth (metres x 5000, 0 = none)
    rgb.txt, depth.txt                       seconds and file of every image
    groundtruth.txt                          seconds tx ty tz qx qy qz qw, first camera from each camera
    camera.toml                              width, height, fx, fy, cx, cy in pixels
    truth/<seconds>.npz                      flow, valid, is_dynamic, odometry to the next frame
    """
    folder = Path(folder)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise DataError(f"{folder}: exists and is not an empty folder; choose a new one")
    steps = [truth.odometry for _, truth in sequence[:-1] if truth is not None]
    if len(steps) != len(sequence) - 1 or any(frame.color is None for frame, _ in sequence):
        raise DataError("a TUM folder needs colour, and the truth of every frame but the last")

    for part in ("rgb", "depth", "truth"):
        (folder / part).mkdir(parents=True)
    seconds = [f"{frame.time_ns * 1e-9:.6f}" for frame, _ in sequence]
    for stamp, (frame, truth) in zip(seconds, sequence, strict=True):
        Image.fromarray(frame.color).save(folder / "rgb" / f"{stamp}.png")
        depth = np.clip(np.round(frame.depth.astype(float) * DEPTH_PER_METRE), 0, 65535).astype(np.uint16)
        Image.fromarray(depth).save(folder / "depth" / f"{stamp}.png")
        if truth is not None:
            np.savez_compressed(folder / "truth" / f"{stamp}.npz", flow=truth.flow, valid=truth.valid,
                                is_dynamic=truth.is_dynamic, odometry=truth.odometry)
    for kind in ("rgb", "depth"):
        rows = "".join(f"{stamp} {kind}/{stamp}.png\n" for stamp in seconds)
        (folder / f"{kind}.txt").write_text(_HEADER.format("filename") + rows, encoding="utf-8")
    poses = pose.to_translation_quaternion(pose.trajectory(np.array(steps).reshape(-1, 4, 4)))
    rows = "".join(f"{stamp} {' '.join(f'{value:.9f}' for value in row)}\n"
                   for stamp, row in zip(seconds, poses, strict=True))
    (folder / "groundtruth.txt").write_text(_HEADER.format("tx ty tz qx qy qz qw") + rows, encoding="utf-8")
    (folder / "camera.toml").write_text(tomli_w.dumps(asdict(camera)), encoding="utf-8")

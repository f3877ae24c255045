"""What a run keeps of every finished RGB-D pair until it is complete; as checkpoints.py for LiDAR pairs."""

import json

import numpy as np

from lidarflow import io, rgbd_io
from lidarflow.checkpoints import CheckpointFiles, Stretch, digest_of, naming_damage, read_bound
from lidarflow.rgbd_types import Exposure, RgbdPair, RgbdResult

_NAMES = ("digest", "stretch", *rgbd_io.RESULT_ARRAYS, "camera", "exposure", "notes")


class RgbdCheckpoints(CheckpointFiles):
    """The checkpoints of an RGB-D run: what goes from pair to pair is the last pair's answer and frame."""

    def save(self, index: int, pair: RgbdPair, result: RgbdResult, stretch: Stretch) -> None:
        """Keep the answer of the pair at `index`."""
        arrays = {name: getattr(result, name) for name in rgbd_io.RESULT_ARRAYS} | {
            "digest": np.array(_digest(pair)), "stretch": stretch.row(),
            "camera": rgbd_io.camera_row(result.camera),
            "exposure": np.array([result.exposure.gain, result.exposure.offset]),
            "notes": np.array(json.dumps({"seconds": result.seconds}))}
        self.put(index, io.archive(arrays))

    def load(self, index: int, pair: RgbdPair) -> tuple[RgbdResult, None]:
        """The answer of the pair at `index`; DataError where it is damaged, or was made of other images."""
        file = self.file(index)
        arrays = read_bound(file, _NAMES, _digest(pair), (pair.source.name, pair.target.name))
        with naming_damage(file):
            return RgbdResult(
                camera=rgbd_io.camera_of(arrays["camera"]),
                seconds=json.loads(str(arrays["notes"]))["seconds"],
                exposure=Exposure(*arrays["exposure"].tolist()),
                **{name: arrays[name] for name in rgbd_io.RESULT_ARRAYS}), None


def _digest(pair: RgbdPair) -> str:
    return digest_of(
        (f"{frame.name} {frame.time_ns} {frame.shape} ", image)
        for frame in (pair.source, pair.target) for image in (frame.intensity, frame.depth, frame.color))

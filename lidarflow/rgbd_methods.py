"""The ways from RGB-D frames to a result that the command line offers, ours and Open3D's, all of one form."""

from typing import Protocol

import numpy as np

from lidarflow import pose
from lidarflow.config import given
from lidarflow.errors import DataError, SolveError
from lidarflow.open3d_import import open3d
from lidarflow.rgbd import RgbdEstimator, pyramid
from lidarflow.rgbd_config import RgbdConfig
from lidarflow.rgbd_types import Camera, RgbdFrame, RgbdPair, RgbdResult, check_is
from lidarflow.stopwatch import Stopwatch

OURS = "ours"
_MAX_DEPTH_M = 10.0


class Estimator(Protocol):
    """Frames of one camera in, in order; the result of the last two out, None after the first.

    tracks  None: no object has a number that goes from pair to pair
    """

    tracks: None

    def step(self, frame: RgbdFrame) -> RgbdResult | None:
        """The result of the last frame and this one; LidarflowError for a frame of no use."""

    def follow(self, frame: RgbdFrame, known: RgbdResult, tracks: None = None) -> None:
        """As `step` where its answer is known: the next step is the same."""

    def reset(self) -> None:
        """Begin anew with the next frame."""


class Open3dOdometry:
    """Open3D's RGB-D odometry (hybrid Jacobian) as a method: one motion for all, nothing moves by itself.

    Works at the size that our method works at, with Open3D's own settings but for the depth, up to 10 m.
    """

    tracks: None = None

    def __init__(self, camera: Camera, config: RgbdConfig | None = None):
        check_is("camera", camera, Camera)
        self._camera, self._images = camera, given(config, RgbdConfig).images
        self.reset()

    def reset(self) -> None:
        """Begin anew with the next frame."""
        self._last: RgbdFrame | None = None

    def follow(self, frame: RgbdFrame, known: RgbdResult, tracks: None = None) -> None:
        """As `step` where its answer is known: the next step is the same."""
        self._last, _ = pyramid.at_working_size(frame, self._camera, self._images)

    def step(self, frame: RgbdFrame) -> RgbdResult | None:
        """Result of the pair of the last frame and this one; SolveError where Open3D finds no motion."""
        timed = Stopwatch()
        source, self._last = self._last, None
        with timed("images"):
            self._last, camera = pyramid.at_working_size(frame, self._camera, self._images)
        if source is None:
            return None
        with timed("odometry"):
            odometry = _hybrid(source, self._last, camera)
        if odometry is None:
            raise SolveError(f"{frame.name}: Open3D's odometry finds no motion that leads to this frame")
        points, valid = camera.points(source.depth), source.depth > 0
        flow = np.where(valid[..., None], pose.apply(odometry, points.astype(float)) - points, 0.0)
        return RgbdResult(
            flow=flow.astype(np.float32), points=points, valid=valid,
            label=np.where(valid, 0, -1).astype(np.int32), b=np.zeros(1),
            cluster_motions=odometry[None], odometry=odometry,
            is_dynamic=np.zeros_like(valid), camera=camera, centres=points[valid].mean(axis=0, keepdims=True),
            seconds=timed.seconds)


def _hybrid(source: RgbdFrame, target: RgbdFrame, camera: Camera) -> np.ndarray | None:
    """The motion (4, 4) float64, target_from_source, that Open3D finds; None where no pixels correspond."""
    o3d = open3d()
    odometry = o3d.pipelines.odometry
    intrinsics = o3d.camera.PinholeCameraIntrinsic(
        camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
    found, motion, information = odometry.compute_rgbd_odometry(
        _image(source), _image(target), intrinsics, np.eye(4),
        odometry.RGBDOdometryJacobianFromHybridTerm(), odometry.OdometryOption(depth_max=_MAX_DEPTH_M))
    # Open3D calls a motion found, the identity or NaN, even where nothing speaks for it.
    rests_on_something = information.any() and np.isfinite(motion).all()
    return np.array(motion) if found and rests_on_something else None


def _image(frame: RgbdFrame):
    """A frame as Open3D's odometry takes it: intensity 0..1 and depth in metres."""
    o3d = open3d()
    image = o3d.geometry.RGBDImage()
    image.color, image.depth = o3d.geometry.Image(frame.intensity), o3d.geometry.Image(frame.depth)
    return image


METHODS = {OURS: RgbdEstimator, "open3d": Open3dOdometry}


def estimator(name: str, camera: Camera, config: RgbdConfig) -> Estimator:
    """A fresh estimator of one of METHODS; DataError for an unknown name."""
    check(name)
    return METHODS[name](camera, config)


def check(name: str) -> None:
    """Raise DataError unless `name` is one of METHODS."""
    if name not in METHODS:
        raise DataError(f"--method {name}: unknown; expected one of {', '.join(METHODS)}")


def estimate_flow(name: str, pair: RgbdPair, config: RgbdConfig) -> RgbdResult:
    """The result of one pair by one of METHODS; DataError for an unknown name."""
    fresh = estimator(name, pair.camera, config)
    fresh.step(pair.source)
    return fresh.step(pair.target)

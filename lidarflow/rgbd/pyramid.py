"""A frame at its working size and at every coarser level, with gradients."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from lidarflow.errors import DataError
from lidarflow.kernels import images
from lidarflow.rgbd_config import ImagesConfig
from lidarflow.rgbd_types import Camera, RgbdFrame, check_is
from lidarflow.rows import sparse

_NEAREST_M = 0.01    # nearer to the camera, or behind it, nothing is seen
_SMALLEST_SIDE = 8   # pixels; a coarser level would have no gradients to speak of


@dataclass(frozen=True, slots=True, eq=False)
class Level:
    """One level of a pyramid.

    camera      Camera               of this size
    intrinsics  (4,) float32         fx, fy, cx, cy
    packed      (H, W, 6) float32    intensity, depth and their gradients (kernels/images.py)
    points      (H, W, 3) float32    metres, camera frame; 0, 0, 0 without depth
    """

    camera: Camera
    intrinsics: np.ndarray
    packed: np.ndarray
    points: np.ndarray

    def some_pixels(self, most: int) -> np.ndarray:
        """Numbers v W + u (N,) of pixels with depth, N ≤ `most`, evenly chosen."""
        return sparse(np.flatnonzero(self.points[..., 2]), most)

    def nearest_pixels(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Whether points (N, 3) [m] are in the image, and number v W + u (N,) of the nearest pixel or 0."""
        height, width = self.points.shape[:2]
        x, y, z = np.asarray(points, float).T
        ahead = z > _NEAREST_M
        z = np.where(ahead, z, 1.0)
        u = np.rint(self.camera.fx * x / z + self.camera.cx)
        v = np.rint(self.camera.fy * y / z + self.camera.cy)
        inside = ahead & (u >= 0) & (u < width) & (v >= 0) & (v < height)
        return inside, np.where(inside, v * width + u, 0.0).astype(int)


def build(frame: RgbdFrame, camera: Camera, config: ImagesConfig) -> tuple[Level, ...]:
    """The levels of a frame, the finest, of the working size, first.

    Raises DataError for a frame without any depth, one that is too small, or not of the camera's size.
    """
    return _levels(*_resized(frame, camera, config), config)


def with_intensity(levels: tuple[Level, ...], intensity: np.ndarray, config: ImagesConfig
                   ) -> tuple[Level, ...]:
    """A pyramid with the depth of another and an intensity (H, W) float32 of its finest size."""
    finest = levels[0]
    return _levels(intensity, np.ascontiguousarray(finest.packed[..., 1]), finest.camera, config)


def _levels(intensity: np.ndarray, depth: np.ndarray, camera: Camera, config: ImagesConfig
            ) -> tuple[Level, ...]:
    levels = [_level(intensity, depth, camera)]
    while len(levels) < config.levels and min(camera.width, camera.height) >= 2 * _SMALLEST_SIDE:
        intensity, depth = images.halve(intensity, depth, config.max_depth_jump_m)
        camera = _halved(camera)
        levels.append(_level(intensity, depth, camera))
    return tuple(levels)


def at_working_size(frame: RgbdFrame, camera: Camera, config: ImagesConfig) -> tuple[RgbdFrame, Camera]:
    """The frame, without its colours, and its camera as the finest level has them; raises as `build`."""
    intensity, depth, camera = _resized(frame, camera, config)
    return RgbdFrame(intensity, depth, frame.time_ns, frame.name), camera


def working_camera(camera: Camera, config: ImagesConfig) -> Camera:
    """The camera at the working size: `config.width` wide and as high in proportion, never enlarged."""
    if camera.width <= config.width:
        return camera
    return camera.scaled(config.width, max(round(camera.height * config.width / camera.width), 1))


def _resized(
    frame: RgbdFrame, camera: Camera, config: ImagesConfig
) -> tuple[np.ndarray, np.ndarray, Camera]:
    """Intensity and depth (H, W) float32 at the working size, and the camera of that size."""
    check_is("frame", frame, RgbdFrame)
    if frame.shape != (camera.height, camera.width):
        height, width = frame.shape
        raise DataError(f"{frame.name}: {width}x{height} pixels, but the camera has "
                        f"{camera.width}x{camera.height}")
    if not frame.depth.any():
        raise DataError(f"{frame.name}: no pixel has a depth; is this the right depth image?")
    camera = working_camera(camera, config)
    if min(camera.width, camera.height) < _SMALLEST_SIDE:
        raise DataError(f"{frame.name}: {camera.width}x{camera.height} pixels are too few to work with; "
                        f"expected at least {_SMALLEST_SIDE} either way")
    if (camera.height, camera.width) == frame.shape:
        return frame.intensity, frame.depth, camera
    smaller = images.resize(
        frame.intensity, frame.depth, camera.width, camera.height, config.max_depth_jump_m)
    return *smaller, camera


def _halved(camera: Camera) -> Camera:
    """The camera of an image that 2x2 pixels were merged in, an odd last row or column left out."""
    even = Camera(camera.width // 2 * 2, camera.height // 2 * 2, camera.fx, camera.fy, camera.cx, camera.cy)
    return even.scaled(even.width // 2, even.height // 2)


def _level(intensity: np.ndarray, depth: np.ndarray, camera: Camera) -> Level:
    intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float32)
    points = _rays(camera) * depth[..., None]
    return Level(camera, intrinsics, images.pack(intensity, depth), points)


@lru_cache(maxsize=16)
def _rays(camera: Camera) -> np.ndarray:
    """Points (H, W, 3) float32 at depth 1."""
    return camera.points(np.ones((camera.height, camera.width), np.float32))

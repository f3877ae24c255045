"""A textured corner of a room, drawn from its equations without noise: pairs whose motion is exact."""

import numpy as np

from lidarflow import pose
from lidarflow.rgbd_types import Camera, RgbdFrame, RgbdPair

QVGA = Camera.from_field_of_view(320, 240)
# Normals and offsets of three walls, n · p = d metres, in the first camera's frame.
WALLS = np.array([[0.5, 0.1, 0.85, 2.6], [-0.75, 0.15, 0.6, 1.9], [0.1, 0.95, 0.2, 1.1]])
WAVES = np.array([[7.0, 3.0, 2.0], [-2.0, 9.0, 4.0], [5.0, -4.0, 8.0], [13.0, 11.0, -6.0]])


def texture(points: np.ndarray) -> np.ndarray:
    """Intensity (...) of points (..., 3) in the first camera's frame."""
    return 0.5 + 0.1 * np.sin(points @ WAVES.T + [0.0, 1.0, 2.0, 3.0]).sum(axis=-1)


def frame(first_from_camera: np.ndarray, camera: Camera = QVGA) -> RgbdFrame:
    """What a camera at a pose sees of the corner."""
    rays = camera.points(np.ones((camera.height, camera.width), np.float32)).astype(float)
    directions, origin = pose.turn(first_from_camera, rays), first_from_camera[:3, 3]
    with np.errstate(divide="ignore"):
        depths = (WALLS[:, 3] - WALLS[:, :3] @ origin) / (directions @ WALLS[:, :3].T)
    depth = np.where(depths > 0, depths, np.inf).min(axis=-1)
    points = origin + directions * depth[..., None]
    return RgbdFrame(texture(points).astype(np.float32), depth.astype(np.float32), name="corner")


def pair(target_from_source: np.ndarray, camera: Camera = QVGA) -> RgbdPair:
    """The corner before and after the camera's motion."""
    return RgbdPair(frame(np.eye(4), camera), frame(pose.inverse(target_from_source), camera), camera)

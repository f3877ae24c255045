"""A rendered RGB-D camera: colour, depth as a structured-light sensor reads it, and the true flow."""

from dataclasses import dataclass

import numpy as np

from lidarflow import pose
from lidarflow.open3d_import import open3d
from lidarflow.rgbd_types import Camera, RgbdFrame, RgbdTruth
from lidarflow.synthetic.kitti import CAMERA_FROM_VELODYNE
from lidarflow.synthetic.raycast import raycasting_scene
from lidarflow.synthetic.rooms import TexturedScene

DYNAMIC_SPEED_M_PER_S = 0.1
_LIGHT = np.array([-0.45, 0.35, 0.82])                 # where it comes from, world
_AMBIENT = 0.72
_JUMP_SHARE = 0.05                                     # of the depth: a larger step is an edge


@dataclass(frozen=True, slots=True)
class RgbdSensor:
    """A colour camera with depth registered to it, read by a projector's pattern beside it.

    camera               Camera
    rate_hz              float   frames per second
    depth_noise_per_m    float   standard deviation of the depth, in metres per square metre of depth
    min_depth_m          float   nothing is read nearer
    max_depth_m          float   or farther
    baseline_m           float   from camera to projector: what its light does not reach has no depth
    dark_level           float   most pixels with less light than this (0..1) have no depth
    loss                 float   chance that any other pixel has none; at depth edges it is half
    image_noise          float   standard deviation of the colour channels, 0..1
    """

    camera: Camera
    rate_hz: float = 30.0
    depth_noise_per_m: float = 1.4e-3
    min_depth_m: float = 0.4
    max_depth_m: float = 4.8
    baseline_m: float = 0.075
    dark_level: float = 0.17
    loss: float = 0.003
    image_noise: float = 0.008


@dataclass(frozen=True, slots=True, eq=False)
class _View:
    """What every pixel of a frame sees.

    points          (N, 3) float64   metres, world
    depth           (N,) float64     metres along the camera's z, inf where nothing is hit
    part            (N,) int         index of the part, len(parts) where nothing is hit
    facing          (N,) float64     cosine between ray and normal, 0..1
    lit             (N,) bool        the projector reaches it
    colours         (N, 3) float32   RGB in 0..1, without noise
    """

    points: np.ndarray
    depth: np.ndarray
    part: np.ndarray
    facing: np.ndarray
    lit: np.ndarray
    colours: np.ndarray


def rgbd_sequence(
    room: TexturedScene, sensor: RgbdSensor, count: int, rng: np.random.Generator
) -> list[tuple[RgbdFrame, RgbdTruth | None]]:
    """`count` frames, each with its truth to the next (None for the last).

    Frames are instantaneous. The truth of a pixel is the rigid motion of the part that is seen there,
    applied to the point as measured, noise included.
    """
    period_s = 1.0 / sensor.rate_hz
    sequence = []
    for k in range(count):
        view = _look(room, sensor, k * period_s)
        frame = _read(view, sensor, round(k * period_s * 1e9), f"{k:06d}", rng)
        last = k == count - 1
        truth = None if last else _truth(room, sensor, view, frame, k * period_s, (k + 1) * period_s)
        sequence.append((frame, truth))
    return sequence


def world_from_camera(room: TexturedScene, time_s: float) -> np.ndarray:
    """Pose (4, 4) of the camera, x right, y down, z forward, in a world with z up."""
    return room.scene.world_from_sensor(time_s, 0.0) @ pose.inverse(CAMERA_FROM_VELODYNE)


def _look(room: TexturedScene, sensor: RgbdSensor, time_s: float) -> _View:
    """Cast a ray through every pixel, and one from what it hits to the projector."""
    pose_now, parts = world_from_camera(room, time_s), room.scene.parts
    scene, tensor = raycasting_scene(list(parts), time_s), open3d().core.Tensor
    height, width = sensor.camera.height, sensor.camera.width
    directions = sensor.camera.points(np.ones((height, width), np.float32)).reshape(-1, 3).astype(float)
    directions = pose.turn(pose_now, directions)
    origin = np.broadcast_to(pose_now[:3, 3], directions.shape)
    hits = scene.cast_rays(tensor(np.column_stack([origin, directions]).astype(np.float32)))

    # Directions reach to depth 1, so the ray's parameter is the depth.
    depth = hits["t_hit"].numpy().astype(float)
    seen = np.isfinite(depth)
    points = np.where(seen[:, None], origin + directions * np.where(seen, depth, 0.0)[:, None], 0.0)
    part = np.where(seen, hits["geometry_ids"].numpy(), len(parts)).astype(int)
    normals = hits["primitive_normals"].numpy().astype(float)
    cosine = (normals * directions).sum(axis=1) / np.linalg.norm(directions, axis=1)
    projector = pose.apply(pose_now, np.array([sensor.baseline_m, 0.0, 0.0]))
    rays = np.column_stack([points, projector - points]).astype(np.float32)
    lit = ~scene.test_occlusions(tensor(rays), tnear=0.005, tfar=0.995).numpy()
    facing_camera = -np.sign(cosine)[:, None] * normals
    colours = _colours(room, time_s, points, part, facing_camera)
    return _View(points, depth, part, np.abs(cosine), lit & seen, colours)


def _colours(room: TexturedScene, time_s: float, points: np.ndarray, part: np.ndarray,
             normals: np.ndarray) -> np.ndarray:
    """RGB (N, 3) float32 of textures that move with their parts, under ambient and directed light."""
    colours = np.zeros((len(points), 3), np.float32)
    for index in np.unique(part[part < len(room.textures)]):
        seen = part == index
        part_from_world = pose.inverse(room.scene.parts[index].world_from_part(time_s))
        colours[seen] = room.textures[index].colours(pose.apply(part_from_world, points[seen]))
    light = _AMBIENT + (1.0 - _AMBIENT) * np.clip(normals @ _LIGHT, 0.0, 1.0)
    return colours * light[:, None].astype(np.float32)


def _read(view: _View, sensor: RgbdSensor, time_ns: int, name: str, rng: np.random.Generator) -> RgbdFrame:
    """The images that the sensor makes of a view."""
    shape = sensor.camera.height, sensor.camera.width
    noisy = view.colours + sensor.image_noise * rng.normal(size=view.colours.shape)
    color = np.round(255.0 * np.clip(noisy, 0.0, 1.0)).astype(np.uint8)
    chance = rng.random(len(view.depth))
    true_depth = np.where(np.isfinite(view.depth), view.depth, 0.0)
    noise_m = sensor.depth_noise_per_m * true_depth**2 * rng.normal(size=len(true_depth))
    lost = ~view.lit | (view.facing < 0.08) | (chance < sensor.loss)
    lost |= (view.depth < sensor.min_depth_m) | (view.depth > sensor.max_depth_m)
    lost |= (view.colours.mean(axis=1) < sensor.dark_level) & (chance < 0.8)
    lost |= _at_edges(true_depth.reshape(shape)).ravel() & (chance < 0.5)
    depth = np.where(lost, 0.0, true_depth + noise_m).astype(np.float32).reshape(shape)
    return RgbdFrame.from_color(color.reshape(*shape, 3), depth, time_ns, name)


def _at_edges(depth: np.ndarray) -> np.ndarray:
    """Pixels (H, W) bool on either side of a step in a depth image (H, W)."""
    edges = np.zeros(depth.shape, bool)
    for axis in (0, 1):
        before, after = np.moveaxis(depth, axis, 0)[:-1], np.moveaxis(depth, axis, 0)[1:]
        step = np.abs(after - before) > _JUMP_SHARE * np.minimum(before, after)
        along = np.moveaxis(edges, axis, 0)     # a view: writes go to `edges`
        along[:-1] |= step
        along[1:] |= step
    return edges


def _truth(room: TexturedScene, sensor: RgbdSensor, view: _View, frame: RgbdFrame, time_s: float,
           next_time_s: float) -> RgbdTruth:
    """Where the parts carry what was measured, seen by the moving camera."""
    world_from_source = world_from_camera(room, time_s)
    target_from_world = pose.inverse(world_from_camera(room, next_time_s))
    odometry = target_from_world @ world_from_source
    points = sensor.camera.points(frame.depth).reshape(-1, 3).astype(float)
    moved = pose.apply(odometry, points)
    is_dynamic = np.zeros(len(points), bool)
    for index in np.unique(view.part[view.part < len(room.scene.parts)]):
        part, seen = room.scene.parts[index], view.part == index
        if part.is_static:
            continue
        world_motion = part.world_from_part(next_time_s) @ pose.inverse(part.world_from_part(time_s))
        by_itself_m = np.linalg.norm(pose.apply(world_motion, view.points[seen]) - view.points[seen], axis=1)
        moved[seen] = pose.apply(target_from_world @ world_motion @ world_from_source, points[seen])
        is_dynamic[seen] = by_itself_m >= DYNAMIC_SPEED_M_PER_S * (next_time_s - time_s)
    valid = frame.depth > 0
    flow = np.where(valid[..., None], (moved - points).reshape(*valid.shape, 3), 0.0)
    return RgbdTruth(flow.astype(np.float32), odometry, valid, is_dynamic.reshape(valid.shape))

"""Ray-cast scans of a scene, each with its true flow to the next."""

from dataclasses import dataclass

import numpy as np

from lidarflow import pose
from lidarflow.open3d_import import open3d
from lidarflow.synthetic.scene import Part, Scene
from lidarflow.synthetic.sensor import Sensor
from lidarflow.synthetic.shapes import moved
from lidarflow.types import Scan, Truth

DYNAMIC_SPEED_M_PER_S = 0.5
_BACKGROUND = -1


@dataclass(frozen=True, slots=True, eq=False)
class _Returns:
    """What one revolution saw: points (N, 3) in the sensor frame and the index of the moving part, or -1."""

    points: np.ndarray
    mover: np.ndarray


def scan_sequence(
    scene: Scene, sensor: Sensor, count: int, rng: np.random.Generator, dt_s: float = 0.1
) -> list[tuple[Scan, Truth | None]]:
    """`count` scans, `dt_s` apart, each with its truth to the next (None for the last).

    Every scan is an instantaneous snapshot: all rays leave at once, there is no rolling shutter. The truth of
    a point is the rigid motion of the part it was seen on, applied to the point as measured, noise included.
    """
    movers = [part for part in scene.parts if not part.is_static]
    static_world = raycasting_scene([part for part in scene.parts if part.is_static], 0.0)
    sequence = []
    for k in range(count):
        time_s = k * dt_s
        world_from_sensor = scene.world_from_sensor(time_s, sensor.height_m)
        returns = _scan(static_world, movers, world_from_sensor, sensor, time_s, rng)
        scan = Scan(returns.points, time_ns=round(time_s * 1e9), name=f"{k:06d}")
        last = k == count - 1
        truth = None if last else _truth(scene, sensor, movers, returns, time_s, (k + 1) * dt_s)
        sequence.append((scan, truth))
    return sequence


def raycasting_scene(parts: list[Part], time_s: float):
    """Open3D RaycastingScene of `parts` in world coordinates; geometry k is parts[k]."""
    o3d = open3d()
    scene = o3d.t.geometry.RaycastingScene()
    for part in parts:
        mesh = moved(part.mesh, part.world_from_part(time_s))
        scene.add_triangles(o3d.core.Tensor(mesh.vertices.astype(np.float32)),
                            o3d.core.Tensor(mesh.triangles.astype(np.uint32)))
    return scene


def _scan(static_world, movers: list[Part], world_from_sensor: np.ndarray, sensor: Sensor, time_s: float,
          rng: np.random.Generator) -> _Returns:
    """One noisy revolution at one instant."""
    directions = sensor.directions(phase=rng.random())
    origin, rotation = world_from_sensor[:3, 3], world_from_sensor[:3, :3]
    rays = np.column_stack([np.broadcast_to(origin, directions.shape), directions @ rotation.T])
    rays = open3d().core.Tensor(rays.astype(np.float32))

    range_m = static_world.cast_rays(rays)["t_hit"].numpy().astype(float)
    mover = np.full(len(directions), _BACKGROUND)
    if movers:
        hits = raycasting_scene(movers, time_s).cast_rays(rays)
        nearer = hits["t_hit"].numpy() < range_m
        range_m[nearer] = hits["t_hit"].numpy()[nearer]
        mover[nearer] = hits["geometry_ids"].numpy()[nearer]

    noise_m = sensor.range_noise_m * rng.normal(size=len(directions))
    kept = (range_m <= sensor.max_range_m) & (rng.random(len(directions)) >= sensor.drop_probability)
    return _Returns(directions[kept] * (range_m + noise_m)[kept, None], mover[kept])


def _truth(scene: Scene, sensor: Sensor, movers: list[Part], returns: _Returns, time_s: float,
           next_time_s: float) -> Truth:
    """Where the parts carry the points, seen by the moving sensor."""
    world_from_source = scene.world_from_sensor(time_s, sensor.height_m)
    target_from_world = pose.inverse(scene.world_from_sensor(next_time_s, sensor.height_m))
    ego_motion = target_from_world @ world_from_source
    points = returns.points
    ego_flow = pose.apply(ego_motion, points) - points
    flow = ego_flow.copy()
    object_id = np.full(len(points), -1, np.int32)
    for index in np.unique(returns.mover[returns.mover != _BACKGROUND]):
        part, seen = movers[index], returns.mover == index
        world_motion = part.world_from_part(next_time_s) @ pose.inverse(part.world_from_part(time_s))
        motion = target_from_world @ world_motion @ world_from_source
        flow[seen] = pose.apply(motion, points[seen]) - points[seen]
        object_id[seen] = part.object_id
    residual_speed = np.linalg.norm(flow - ego_flow, axis=1) / (next_time_s - time_s)
    return Truth(
        flow=flow,
        ego_motion=ego_motion,
        valid=np.ones(len(points), bool),
        is_dynamic=residual_speed >= DYNAMIC_SPEED_M_PER_S,
        object_id=object_id,
    )

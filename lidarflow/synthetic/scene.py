"""A world of rigid parts that a sensor drives through."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lidarflow import pose
from lidarflow.synthetic.shapes import Mesh

Path = Callable[[float], np.ndarray]
"""Seconds to a (4, 4) pose."""


def at_rest(time_s: float) -> np.ndarray:
    """The path of everything that stands still: its mesh is in world coordinates."""
    return pose.identity()


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """A rigid piece of the world; several moving parts with one id make a jointed object.

    mesh             Mesh              metres, in the part's own frame
    name             str               what it is, e.g. "ground" or "pedestrian 7 left arm"
    object_id        int               -1 for whatever stands still
    world_from_part  seconds -> (4, 4)
    """

    mesh: Mesh
    name: str
    object_id: int = -1
    world_from_part: Path = at_rest

    def __post_init__(self):
        if (self.object_id == -1) != self.is_static or self.object_id < -1:
            raise ValueError(f"Part '{self.name}': object_id is -1 if and only if the part is at rest")

    @property
    def is_static(self) -> bool:
        return self.world_from_part is at_rest


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """Rigid parts and the path of the vehicle that carries the sensor.

    parts               tuple of Part
    world_from_vehicle  seconds -> (4, 4)   origin on the ground below the sensor
    """

    parts: tuple[Part, ...]
    world_from_vehicle: Path

    def world_from_sensor(self, time_s: float, height_m: float = 1.73) -> np.ndarray:
        """Pose (4, 4) of a sensor mounted `height_m` over ground."""
        return self.world_from_vehicle(time_s) @ pose.from_translation(np.array([0.0, 0.0, height_m]))

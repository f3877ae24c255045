"""Small scenes for tests: a yard the sensor moves in, and an open place with one moving car."""

import numpy as np

from lidarflow import pose
from lidarflow.synthetic import surroundings
from lidarflow.synthetic.scene import Part, Path, Scene
from lidarflow.synthetic.shapes import Mesh, box, merged, moved, sheet
from lidarflow.synthetic.vehicles import car


def room(rng: np.random.Generator, speed_m_per_s: float = 2.0, turn_rad_per_s: float = 0.2) -> Scene:
    """A static yard of 24 x 18 m between house fronts, with boxes, a tree, a lamp and a parked car.

    The sensor starts near the middle; at the default speeds it stays clear of everything for two seconds.
    """
    half_x, half_y = 12.0, 9.0
    walls = []
    for width, yaw, place in ((2 * half_x, 0.0, (0, half_y)), (2 * half_x, np.pi, (0, -half_y)),
                              (2 * half_y, -np.pi / 2, (half_x, 0)), (2 * half_y, np.pi / 2, (-half_x, 0))):
        wall = surroundings.facade(width, 2, True, rng)
        walls.append(moved(wall, pose.from_yaw(yaw, np.array([*place, 0.0]))))
    things = [box((1.2, 0.8, 1.0)), box((0.8, 0.8, 1.8)), box((2.0, 0.7, 0.8)), surroundings.tree(rng),
              surroundings.bush(rng), surroundings.lamp(), surroundings.litter_bin(), car(rng)]
    angles = np.arange(len(things)) * (2 * np.pi / len(things)) + rng.uniform(0, 2 * np.pi)
    placed = [
        set_down(thing, 8.5 * np.cos(angle), 6.2 * np.sin(angle), rng.uniform(0, 2 * np.pi))
        for thing, angle in zip(things, angles, strict=True)
    ]
    parts = (Part(uneven_ground(2 * half_x, 2 * half_y, rng), "ground"), Part(merged(walls), "walls"),
             Part(merged(placed), "things"))
    return Scene(parts, _arc((-1.0, 0.0), speed_m_per_s, turn_rad_per_s))


def one_car(speed_m_per_s: float, rng: np.random.Generator) -> Scene:
    """An open place with a house, a hedge, trees and poles, where one car (object 0) drives along x.

    The sensor itself moves at 4 m/s along x, in a slight bend.
    """
    house = moved(surroundings.building(26.0, 9.0, rng), pose.from_translation(np.array([8.0, 14.0, 0.0])))
    hedge = set_down(surroundings.hedge(20.0, rng), 8.0, -11.0, 0.0)
    things = [surroundings.tree(rng), surroundings.lamp(), surroundings.tree(rng), surroundings.sign(rng),
              car(rng)]
    places = ((-8.0, 9.0), (3.0, 8.0), (20.0, 8.5), (14.0, -7.5), (2.0, -7.0))
    placed = [set_down(thing, x, y, 0.1) for thing, (x, y) in zip(things, places, strict=True)]
    ground = uneven_ground(80.0, 80.0, rng)
    drive = _arc((9.0, 3.5), speed_m_per_s, 0.0)
    parts = (Part(ground, "ground"), Part(merged([house, hedge, *placed]), "surroundings"),
             Part(car(rng), "car 0", 0, drive))
    return Scene(parts, _arc((0.0, 0.0), 4.0, 0.03))


def set_down(mesh: Mesh, x: float, y: float, yaw: float) -> Mesh:
    """The mesh turned and set at (x, y) with its lowest point at most at the ground."""
    lift = max(0.0, -float(mesh.vertices[:, 2].min()) - 0.2)
    return moved(mesh, pose.from_yaw(yaw, np.array([x, y, lift])))


def uneven_ground(size_x: float, size_y: float, rng: np.random.Generator) -> Mesh:
    """A rectangle around the origin that rises and falls by a few centimetres."""
    share = np.linspace(-0.5, 0.5, 81)
    x, y = np.meshgrid(share * size_x, share * size_y, indexing="ij")
    waves = np.column_stack([rng.uniform(-0.8, 0.8, (4, 2)), rng.uniform(0, 2 * np.pi, 4)])
    z = 0.012 * np.sin(x[..., None] * waves[:, 0] + y[..., None] * waves[:, 1] + waves[:, 2]).sum(axis=-1)
    return sheet(np.stack([x, y, z], axis=-1))


def _arc(start: tuple[float, float], speed_m_per_s: float, turn_rad_per_s: float) -> Path:
    """Steady driving from `start` along x, turning at a steady rate."""
    begin = pose.from_translation(np.array([*start, 0.0]))
    velocity = np.array([0.0, 0.0, turn_rad_per_s, speed_m_per_s, 0.0, 0.0])
    return lambda time_s: begin @ pose.exp(velocity * time_s)

"""The demo's street: an ego vehicle among parked and moving cars, cyclists and pedestrians."""

import numpy as np

from lidarflow import pose
from lidarflow.synthetic import surroundings
from lidarflow.synthetic.people import cyclist, pedestrian
from lidarflow.synthetic.road import Road, winding_road
from lidarflow.synthetic.scene import Part, Path, Scene
from lidarflow.synthetic.shapes import Mesh, merged, moved
from lidarflow.synthetic.vehicles import car, van

EGO_SPEED_M_PER_S = 8.0
_START, _END = -90.0, 230.0
_LANE_D, _PARKING_D, _FURNITURE_D, _PAVEMENT_D, _FRONT_D = 1.75, 5.65, 6.95, 8.0, 9.8
_CROSSING_CAR_S = 28.0
# Start s, d and speed along the road of everyone who moves; places are metres, speeds metres per second.
_CARS = ((11.0, -_LANE_D, 8.5), (-10.5, -_LANE_D, 7.4), (21.0, _LANE_D, -9.0), (58.0, _LANE_D, -10.5),
         (-9.0, _LANE_D, -8.0))
_VANS = ((74.0, _LANE_D, -8.5), (44.0, -_LANE_D, 10.5))
_CYCLISTS = ((9.5, -4.1, 5.0), (17.0, 4.1, -5.5))
_PEDESTRIANS = ((6.5, -_PAVEMENT_D, 1.4), (12.0, -8.8, -1.2), (5.0, _PAVEMENT_D, -1.3), (10.0, 8.7, 1.5),
                (13.5, 7.9, 1.1))
_ROAD_CROSSING_PEDESTRIAN = (17.5, -4.2, -1.4)
_FREE_S = (3.0, 9.0)
_FURNITURE = {"tree": 0.25, "lamp": 0.15, "sign": 0.15, "bin": 0.1, "hedge": 0.25, "none": 0.1}


def street(rng: np.random.Generator) -> Scene:
    """A city street; the sensor drives at 8 m/s along a slight bend, for some 200 m.

    Static: ground, buildings, trees, poles, parked cars. Moving, each with an object id: cars ahead, behind,
    oncoming and crossing, vans, cyclists, pedestrians.
    """
    road = winding_road(rng)
    static = [
        Part(road.ground((_START, _END), 90.0), "ground"),
        Part(merged(_houses(road, rng)), "houses"),
        Part(merged(_furniture(road, rng)), "furniture"),
        Part(merged(_parked_cars(road, rng)), "parked cars"),
    ]
    return Scene(tuple(static + _movers(road, rng)), _ego_path(road))


def _ego_path(road: Road) -> Path:
    """The right lane at a steady speed, pitching and rolling a little."""
    drive = road.path((0.0, -_LANE_D), (EGO_SPEED_M_PER_S, 0.0))

    def world_from_vehicle(time_s: float) -> np.ndarray:
        roll, pitch = 0.003 * np.sin(4.1 * time_s), 0.004 * np.sin(7.3 * time_s + 1.0)
        return drive(time_s) @ pose.exp(np.array([roll, pitch, 0.0, 0.0, 0.0, 0.0]))

    return world_from_vehicle


def _movers(road: Road, rng: np.random.Generator) -> list[Part]:
    parts: list[Part] = []
    objects = 0
    for make, name, drives in ((car, "car", _CARS), (van, "van", _VANS)):
        for s, d, speed in drives:
            path = road.path((s, d), (speed, 0.0))
            parts.append(Part(make(rng), f"{name} {objects}", objects, path))
            objects += 1
    crossing = road.path((_CROSSING_CAR_S, 6.5), (0.0, -8.0))
    parts.append(Part(car(rng), f"car {objects}", objects, crossing))
    objects += 1
    for s, d, speed in _CYCLISTS:
        parts += cyclist(objects, road.path((s, d), (speed, 0.0)), rng)
        objects += 1
    for s, d, speed in _PEDESTRIANS:
        parts += pedestrian(objects, road.path((s, d), (speed, 0.0)), abs(speed), rng)
        objects += 1
    s, d, speed = _ROAD_CROSSING_PEDESTRIAN
    return parts + pedestrian(objects, road.path((s, d), (0.0, speed)), abs(speed), rng)


def _facing_road(road: Road, mesh: Mesh, s: float, d: float) -> Mesh:
    """A mesh whose front looks to -y, set at (s, d) with its front to the road."""
    return moved(mesh, road.pose_at(s, d, 0.0 if d > 0 else np.pi))


def _is_crossing(road: Road, first: float, last: float) -> bool:
    return last > road.crossing[0] and first < road.crossing[1]


def _houses(road: Road, rng: np.random.Generator) -> list[Mesh]:
    """Houses on both sides with a few gaps, some behind front gardens with fence or hedge."""
    pieces = []
    for side in (-1, 1):
        s = _START + 5.0
        while s < _END - 20.0:
            width = rng.uniform(8.0, 15.0)
            if _is_crossing(road, s, s + width):
                s = road.crossing[1] + 0.1
                continue
            middle = s + width / 2
            setback = rng.choice([0.0, 0.4, 3.2], p=[0.3, 0.3, 0.4])
            house = surroundings.building(width - 0.1, rng.uniform(8.0, 11.0), rng)
            pieces.append(_facing_road(road, house, middle, side * (_FRONT_D + setback)))
            if setback > 1.0:
                pieces += _front_garden(road, middle, width, side, rng)
            s += width
            if rng.random() < 0.25:
                tree = surroundings.tree(rng, crown_m=1.0)
                pieces.append(_facing_road(road, tree, s + 2.0, side * (_FRONT_D + 3.0)))
                s += 4.0
    return pieces


def _front_garden(road: Road, middle: float, width: float, side: int, rng: np.random.Generator) -> list[Mesh]:
    is_fenced = rng.random() < 0.5
    border = surroundings.fence(width - 2.0) if is_fenced else surroundings.hedge(width - 2.0, rng)
    pieces = [_facing_road(road, border, middle, side * (_FRONT_D + 0.2))]
    for offset in rng.uniform(-width / 2 + 1.0, width / 2 - 1.0, 3):
        pieces.append(_facing_road(road, surroundings.bush(rng), middle + offset, side * (_FRONT_D + 1.6)))
    return pieces


def _furniture(road: Road, rng: np.random.Generator) -> list[Mesh]:
    """Trees, lamps, signs, bins and hedges along the kerbs."""
    pieces = []
    for side in (-1, 1):
        for s in np.arange(_START + 6.0, _END - 10.0, 5.0) + rng.uniform(-1.0, 1.0):
            kind = rng.choice(list(_FURNITURE), p=list(_FURNITURE.values()))
            if _is_crossing(road, s - 2.0, s + 2.0) or kind == "none":
                continue
            makers = {"tree": lambda: surroundings.tree(rng), "lamp": surroundings.lamp,
                      "sign": lambda: surroundings.sign(rng), "bin": surroundings.litter_bin,
                      "hedge": lambda: surroundings.hedge(3.6, rng)}
            mesh = makers[kind]()
            if kind == "sign":
                pieces.append(moved(mesh, road.pose_at(s, side * _FURNITURE_D, rng.normal(scale=0.1))))
            else:
                pieces.append(_facing_road(road, mesh, s, side * _FURNITURE_D))
    return pieces


def _parked_cars(road: Road, rng: np.random.Generator) -> list[Mesh]:
    """Cars and a few vans in the parking lanes; a gap beside the start lets the sensor see the pavement."""
    pieces = []
    for side in (-1, 1):
        s = _START + 4.0
        while s < _END - 10.0:
            s += rng.uniform(5.8, 7.0)
            if rng.random() < 0.25 or _is_crossing(road, s - 3.0, s + 3.0) or _FREE_S[0] < s < _FREE_S[1]:
                continue
            make = van if rng.random() < 0.12 else car
            yaw = (0.0 if side < 0 else np.pi) + rng.normal(scale=0.02)
            place = road.pose_at(s, side * (_PARKING_D + rng.uniform(-0.1, 0.1)), yaw)
            pieces.append(moved(make(rng), place))
    return pieces

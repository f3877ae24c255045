"""A person who stands and moves the arms or the trunk: motions no single rigid motion explains."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lidarflow import pose
from lidarflow.errors import DataError
from lidarflow.synthetic import body, surroundings
from lidarflow.synthetic.places import set_down, uneven_ground
from lidarflow.synthetic.scene import Part, Path, Scene, at_rest
from lidarflow.synthetic.shapes import Mesh, box, merged, moved, shifted

LIMBS = ("legs", "abdomen", "chest", "left upper arm", "left forearm", "right upper arm", "right forearm")
"""What the person is made of; the place in this row is a limb's object id."""

_WAIST, _MID_BACK = np.array([0.0, 0.0, 0.95]), np.array([0.0, 0.0, 1.15])
_OVERLAP_M = 0.06              # of the pieces of the trunk, so that no gap opens when it bends
_ARM_REST, _ELBOW_REST = 0.15, 0.10
_NEAREST_M, _FARTHEST_M = 3.0, 11.0


@dataclass(frozen=True, slots=True)
class Posture:
    """Joint angles in radians; at zero the person stands upright and the arms hang.

    forward, right              bend of the trunk, half of it at the waist and half in mid-back
    left_raised, right_raised   arms away from the body, sidewards
    arms_back                   both arms, backwards
    left_elbow, right_elbow     forearm towards the shoulder
    """

    forward: float = 0.0
    right: float = 0.0
    left_raised: float = _ARM_REST
    right_raised: float = _ARM_REST
    arms_back: float = 0.0
    left_elbow: float = _ELBOW_REST
    right_elbow: float = _ELBOW_REST


def _to_and_fro(time_s: float, low: float, high: float, one_way_s: float) -> float:
    """An angle between `low` and `high`; at time zero it is already on its way up, a sixth of the time in."""
    share = time_s / one_way_s + 1.0 / 6.0
    return low + (high - low) * 0.5 * (1.0 - np.cos(np.pi * share))


def _arms_up_down(time_s: float) -> Posture:
    up = _to_and_fro(time_s, 0.2, 1.9, 1.35)
    down = 2.1 - up
    return Posture(left_raised=up, right_raised=down, left_elbow=0.1 + 0.2 * up, right_elbow=0.1 + 0.2 * down)


def _arms_backwards(time_s: float) -> Posture:
    back = _to_and_fro(time_s, -1.1, 0.6, 1.35)
    elbow = 0.3 - 0.2 * back
    return Posture(arms_back=back, left_elbow=elbow, right_elbow=elbow)


def _bend_sidewards(time_s: float) -> Posture:
    right = _to_and_fro(time_s, -0.45, 0.45, 1.4)
    # The arm on the inside of the bend hangs down, the other one lies against the body.
    return Posture(right=right, left_raised=max(_ARM_REST, -right), right_raised=max(_ARM_REST, right))


def _bend_forward(time_s: float) -> Posture:
    forward = _to_and_fro(time_s, 0.0, 1.1, 1.75)
    return Posture(forward=forward, arms_back=-forward)   # the arms keep hanging


MOTIONS: dict[str, Callable[[float], Posture]] = {
    "arms_up_down": _arms_up_down,
    "arms_backwards": _arms_backwards,
    "bend_sidewards": _bend_sidewards,
    "bend_forward": _bend_forward,
}
"""Posture at a time in seconds, for one arm up while the other goes down, both arms from the front to the
back, the trunk to the side and to the front: for 0.9 s arms at 1 to 2 rad/s, the trunk at 0.5 to 1 rad/s."""


def human_motion(name: str, rng: np.random.Generator, distance_m: float = 8.0,
                 world_from_vehicle: Path = at_rest) -> Scene:
    """A person `distance_m` ahead of where the sensor starts, in a yard with a house front behind.

    `name` is one of MOTIONS. The person looks at the sensor, give or take 20 degrees, and is 1.61 to 1.89 m
    tall. Every limb is an object of its own, its id the place in LIMBS. The sensor stands still unless it is
    given a path. Raises DataError for an unknown motion or a distance outside of the yard.
    """
    if name not in MOTIONS:
        raise DataError(f"human motion '{name}': unknown, expected one of {', '.join(MOTIONS)}")
    if not _NEAREST_M <= distance_m <= _FARTHEST_M:
        raise DataError(f"human motion: a person {distance_m:g} m away has no room in the yard; expected "
                        f"{_NEAREST_M:g} to {_FARTHEST_M:g} m")
    scale, yaw = rng.uniform(0.92, 1.08), np.pi + rng.uniform(-0.35, 0.35)
    feet = pose.from_yaw(yaw, np.array([distance_m, 0.0, 0.0]))
    return Scene((*_yard(rng), *person(MOTIONS[name], lambda time_s: feet, scale)), world_from_vehicle)


def person(posture: Callable[[float], Posture], world_from_feet: Path, scale: float = 1.0) -> list[Part]:
    """The limbs of a person of 1.75 m times `scale`, in the order of LIMBS."""
    trunk_low, trunk_high = body.TRUNK_M
    hips = [np.array(body.HIP) * (1, side, 1) * scale for side in (1, -1)]
    pelvis = body.trunk(scale, trunk_low, _WAIST[2] + _OVERLAP_M)
    abdomen = body.trunk(scale, _WAIST[2] - _OVERLAP_M, _MID_BACK[2] + _OVERLAP_M)
    chest = merged([body.trunk(scale, _MID_BACK[2] - _OVERLAP_M, trunk_high), body.head(scale)])

    def half_bend(time_s: float) -> np.ndarray:
        now = posture(time_s)
        return 0.5 * np.array([now.right, now.forward, 0.0])

    world_from_abdomen = body.hinged(world_from_feet, _WAIST * scale, half_bend)
    world_from_chest = body.hinged(world_from_abdomen, (_MID_BACK - _WAIST) * scale, half_bend)
    paths = [world_from_feet, world_from_abdomen, world_from_chest]
    meshes = [merged([pelvis, *(shifted(body.leg(scale), *hip) for hip in hips)]),
              _from(abdomen, _WAIST * scale), _from(chest, _MID_BACK * scale)]
    for side in (1, -1):
        shoulder = (np.array(body.SHOULDER) * (1, side, 1) - _MID_BACK) * scale
        upper = body.hinged(world_from_chest, shoulder,
                            lambda time_s, side=side: _shoulder(posture(time_s), side))
        lower = body.hinged(upper, np.array(body.ELBOW) * scale,
                            lambda time_s, side=side: _elbow(posture(time_s), side))
        paths += [upper, lower]
        meshes += [body.upper_arm(scale), body.forearm(scale)]
    return [Part(mesh, f"person {name}", limb, path)
            for limb, (name, mesh, path) in enumerate(zip(LIMBS, meshes, paths, strict=True))]


def _from(mesh: Mesh, joint: np.ndarray) -> Mesh:
    """The mesh with its origin at `joint`."""
    return shifted(mesh, *-joint)


def _shoulder(now: Posture, side: int) -> np.ndarray:
    """Rotation vector (3,) of the left (1) or right (-1) upper arm."""
    raised = now.left_raised if side == 1 else -now.right_raised
    return np.array([raised, now.arms_back, 0.0])


def _elbow(now: Posture, side: int) -> np.ndarray:
    """Rotation vector (3,) of the left (1) or right (-1) forearm."""
    return np.array([0.0, -(now.left_elbow if side == 1 else now.right_elbow), 0.0])


def _yard(rng: np.random.Generator) -> list[Part]:
    """Uneven ground, house fronts behind and to the left, and a few things beside the person."""
    behind = moved(surroundings.facade(24.0, 2, True, rng),
                   pose.from_yaw(-np.pi / 2, np.array([14.0, 0.0, 0.0])))
    left = shifted(surroundings.facade(26.0, 2, False, rng), 1.0, 11.0)
    things = [(surroundings.tree(rng), 10.5, 5.0), (surroundings.bush(rng), 11.5, -3.0),
              (surroundings.litter_bin(), 9.0, 3.0), (surroundings.lamp(), 6.0, -6.0),
              (box((1.2, 0.8, 1.0)), 7.0, -3.5), (box((2.0, 0.7, 0.8)), -6.0, 4.0),
              (surroundings.tree(rng), -7.0, -5.0), (surroundings.hedge(8.0, rng), -2.0, -9.0)]
    placed = [set_down(thing, x, y, rng.uniform(0, 2 * np.pi)) for thing, x, y in things]
    return [Part(uneven_ground(60.0, 60.0, rng), "ground"), Part(merged([behind, left]), "walls"),
            Part(merged(placed), "things")]

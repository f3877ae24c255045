"""Pedestrians that walk and cyclists that pedal: jointed objects of rigid parts."""

from collections.abc import Callable

import numpy as np

from lidarflow import pose
from lidarflow.synthetic import body
from lidarflow.synthetic.scene import Part, Path
from lidarflow.synthetic.shapes import Mesh, box, ellipsoid, merged, tube

_LEG_SWING, _ARM_SWING = 0.42, 0.48


def pedestrian(
    object_id: int, world_from_feet: Path, speed_m_per_s: float, rng: np.random.Generator
) -> list[Part]:
    """Torso with head, two arms and two legs that swing in step with the walking speed."""
    scale = rng.uniform(0.92, 1.08)
    start = rng.uniform(0, 2 * np.pi)
    step_m = 2 * body.HIP[2] * scale * np.sin(_LEG_SWING)
    phase_per_s = np.pi * speed_m_per_s / step_m
    leg_m = body.HIP[2] * scale

    def phase(time_s: float) -> float:
        return start + phase_per_s * time_s

    def world_from_body(time_s: float) -> np.ndarray:
        sink = leg_m * (np.cos(_LEG_SWING * np.sin(phase(time_s))) - 1.0)
        return world_from_feet(time_s) @ pose.from_translation(np.array([0.0, 0.0, sink]))

    def limb(name: str, mesh: Mesh, joint: tuple, side: int, swing: float) -> Part:
        at = np.array(joint) * (scale, side * scale, scale)
        path = _swinging(world_from_body, at, lambda time_s: swing * np.sin(phase(time_s)))
        return Part(mesh, f"pedestrian {object_id} {name}", object_id, path)

    torso = merged([body.trunk(scale), body.head(scale)])
    arm, leg = body.arm(scale), body.leg(scale)
    return [
        Part(torso, f"pedestrian {object_id} torso", object_id, world_from_body),
        limb("left leg", leg, body.HIP, 1, _LEG_SWING),
        limb("right leg", leg, body.HIP, -1, -_LEG_SWING),
        limb("left arm", arm, body.SHOULDER, 1, -_ARM_SWING),
        limb("right arm", arm, body.SHOULDER, -1, _ARM_SWING),
    ]


def cyclist(object_id: int, world_from_bicycle: Path, rng: np.random.Generator) -> list[Part]:
    """A bicycle with its rider, and two legs that pedal."""
    start, phase_per_s = rng.uniform(0, 2 * np.pi), 2 * np.pi * rng.uniform(1.1, 1.4)
    hips = np.array([-0.22, 0.10, 1.00])

    def leg(name: str, side: int) -> Part:
        path = _swinging(world_from_bicycle, hips * (1, side, 1),
                         lambda time_s: -0.55 + side * 0.30 * np.sin(start + phase_per_s * time_s))
        return Part(body.leg(0.95), f"cyclist {object_id} {name}", object_id, path)

    frame = Part(merged([_bicycle(), _rider()]), f"cyclist {object_id} body", object_id, world_from_bicycle)
    return [frame, leg("left leg", 1), leg("right leg", -1)]


def _swinging(world_from_body: Path, joint: np.ndarray, angle: Callable[[float], float]) -> Path:
    """The path of a limb that turns by `angle` radians about y through `joint`; forward is negative."""
    return body.hinged(world_from_body, joint, lambda time_s: np.array([0.0, angle(time_s), 0.0]))


def _bicycle() -> Mesh:
    angle = np.linspace(0, 2 * np.pi, 17)
    circle = 0.33 * np.stack([np.cos(angle), np.zeros(17), np.sin(angle)], axis=1)
    wheels = [tube(circle + [x, 0, 0.33], np.full(17, 0.025), sides=5) for x in (-0.52, 0.52)]
    hubs = [tube(np.array([[x, -0.04, 0.33], [x, 0.04, 0.33]]), np.full(2, 0.05)) for x in (-0.52, 0.52)]
    bars = [
        [[-0.52, 0, 0.33], [0, 0, 0.30]], [[0, 0, 0.30], [-0.20, 0, 0.95]], [[0, 0, 0.30], [0.38, 0, 0.80]],
        [[-0.16, 0, 0.82], [0.38, 0, 0.80]], [[0.36, 0, 1.05], [0.52, 0, 0.33]],
        [[0.36, -0.28, 1.05], [0.36, 0.28, 1.05]],
    ]
    frame = [tube(np.array(bar), np.full(2, 0.025), sides=6) for bar in bars]
    return merged([*wheels, *hubs, *frame, box((0.25, 0.14, 0.05), (-0.22, 0, 0.97))])


def _rider() -> Mesh:
    """Torso leaning forward, head, and both arms to the handle bar."""
    spine = np.array([[-0.26, 0, 0.98], [-0.20, 0, 1.12], [-0.05, 0, 1.35], [0.02, 0, 1.48], [0.06, 0, 1.56]])
    torso = tube(spine, np.array([0.15, 0.16, 0.18, 0.13, 0.05]), sides=12)
    head = ellipsoid((0.11, 0.0, 1.66), (0.12, 0.09, 0.13))
    arms = [
        tube(np.array([[0.0, side * 0.20, 1.42], [0.16, side * 0.26, 1.20], [0.36, side * 0.24, 1.07]]),
             np.array([0.055, 0.045, 0.035]), sides=8)
        for side in (-1, 1)
    ]
    return merged([torso, head, *arms])

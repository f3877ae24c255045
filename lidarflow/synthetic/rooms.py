"""Rooms for an RGB-D camera held in the hand: textured, with things that move."""

from dataclasses import dataclass

import numpy as np

from lidarflow import pose
from lidarflow.synthetic.people import pedestrian
from lidarflow.synthetic.scene import Part, Path, Scene
from lidarflow.synthetic.shapes import Mesh, box, ellipsoid, merged, moved, relief, shifted, tube
from lidarflow.synthetic.texture import Texture, random_texture

_FAR_X, _NEAR_X, _HALF_Y, _HEIGHT = 4.2, -1.2, 2.4, 2.6
_EYE = (0.0, 0.0, 1.25)
_LOOKS_DOWN = np.deg2rad(8.0)
_CLOTH = {"torso": (0.75, 0.30, 0.25), "leg": (0.30, 0.35, 0.60), "arm": (0.85, 0.65, 0.50)}


@dataclass(frozen=True, slots=True, eq=False)
class TexturedScene:
    """A scene whose vehicle is the hand that holds the camera, and a texture for each of its parts."""

    scene: Scene
    textures: tuple[Texture, ...]

    def __post_init__(self):
        if len(self.textures) != len(self.scene.parts):
            raise ValueError(f"TexturedScene: {len(self.textures)} textures for "
                             f"{len(self.scene.parts)} parts")


def living_room(rng: np.random.Generator) -> TexturedScene:
    """A furnished room where a box (object 0) slides to the right and a person (object 1) walks to the left.

    World: z up, x away from the camera as it starts, y to the left.
    """
    parts, colours = _furnished_room(rng)
    crate = shifted(box((0.5, 0.5, 0.6)), z=0.3)
    parts.append(Part(crate, "box", 0, _straight((2.4, 0.75, 0.45), (-0.45, -0.8, 0.0), 0.4)))
    colours.append((0.80, 0.62, 0.35))
    walk = _straight((2.1, -0.85, 0.0), (0.0, 1.2, 0.0), np.pi / 2)
    for part in pedestrian(1, walk, 1.2, rng):
        parts.append(part)
        colours.append(next(colour for word, colour in _CLOTH.items() if word in part.name))
    return _textured(parts, colours, rng)


def passing_wardrobe(rng: np.random.Generator) -> TexturedScene:
    """The same room; a wardrobe (object 0) is carried in from the left and hides half of it after 0.6 s."""
    parts, colours = _furnished_room(rng)
    wardrobe = shifted(merged([box((0.6, 1.3, 2.2)), box((0.1, 0.5, 0.8), (-0.3, 0.3, 0.25)),
                               box((0.16, 0.25, 0.5), (-0.32, -0.35, -0.2))]), z=1.1)
    parts.append(Part(wardrobe, "wardrobe", 0, _straight((1.6, 1.5, 0.1), (0.1, -1.6, 0.0), 0.15)))
    colours.append((0.70, 0.50, 0.35))
    return _textured(parts, colours, rng)


def _textured(parts: list[Part], colours: list[tuple], rng: np.random.Generator) -> TexturedScene:
    scene = Scene(tuple(parts), _hand_held(rng))
    return TexturedScene(scene, tuple(random_texture(colour, rng) for colour in colours))


def _furnished_room(rng: np.random.Generator) -> tuple[list[Part], list[tuple]]:
    """Floor, ceiling, walls and furniture, x away from the camera, and a colour for each."""
    depth, middle_x = _FAR_X - _NEAR_X, (_FAR_X + _NEAR_X) / 2
    slab = box((1.2 * depth, 2.4 * _HALF_Y, 0.1), (middle_x, 0.0, -0.05))
    # Walls reach past their corners, so that no step in one of them opens a gap.
    side = relief(np.linspace(-0.6, 0.6, 8) * depth, np.array([0.0, 0.9, 1.9, _HEIGHT]),
                  rng.choice([0.0, 0.06, -0.05], (7, 3)))
    far = relief(np.linspace(-1.2, 1.2, 10) * _HALF_Y, np.array([0.0, 0.8, 1.5, 2.1, _HEIGHT]),
                 rng.choice([0.0, -0.08, 0.12], (9, 4)))
    pieces: list[tuple[str, Mesh, tuple]] = [
        ("floor", slab, (0.60, 0.50, 0.42)),
        ("ceiling", shifted(slab, z=_HEIGHT + 0.1), (0.80, 0.80, 0.78)),
        ("far wall", moved(far, pose.from_yaw(-np.pi / 2, (_FAR_X, 0.0, 0.0))), (0.72, 0.70, 0.60)),
        ("left wall", moved(side, pose.from_translation((middle_x, _HALF_Y, 0.0))), (0.55, 0.65, 0.70)),
        ("right wall", moved(side, pose.from_yaw(np.pi, (middle_x, -_HALF_Y, 0.0))), (0.65, 0.58, 0.68)),
        ("near wall", box((0.1, 2 * _HALF_Y, _HEIGHT), (_NEAR_X, 0.0, _HEIGHT / 2)), (0.7, 0.7, 0.7)),
        ("table", shifted(_table(), 3.0, -1.35), (0.62, 0.45, 0.30)),
        ("cupboard", box((0.5, 1.0, 1.5), (3.85, 1.2, 0.75)), (0.50, 0.62, 0.45)),
        ("chair", moved(_chair(), pose.from_yaw(0.6, (1.9, 1.45, 0.0))), (0.75, 0.35, 0.30)),
        ("lamp", shifted(_lamp(), 3.6, 0.25), (0.85, 0.80, 0.55)),
        ("vase", ellipsoid((3.0, -1.3, 0.92), (0.13, 0.13, 0.18), 14), (0.35, 0.45, 0.75)),
    ]
    return [Part(mesh, name) for name, mesh, _ in pieces], [colour for _, _, colour in pieces]


def _table() -> Mesh:
    legs = [box((0.07, 0.07, 0.72), (x, y, 0.36)) for x in (-0.33, 0.33) for y in (-0.5, 0.5)]
    return merged([box((0.8, 1.2, 0.05), (0.0, 0.0, 0.74)), *legs])


def _chair() -> Mesh:
    legs = [box((0.05, 0.05, 0.45), (x, y, 0.22)) for x in (-0.2, 0.2) for y in (-0.2, 0.2)]
    seat, back = box((0.46, 0.46, 0.06), (0.0, 0.0, 0.46)), box((0.05, 0.46, 0.5), (0.21, 0.0, 0.72))
    return merged([seat, back, *legs])


def _lamp() -> Mesh:
    stand = tube(np.array([[0, 0, 0.0], [0, 0, 0.04], [0, 0, 0.06], [0, 0, 1.4]]),
                 np.array([0.17, 0.16, 0.03, 0.03]), sides=12)
    return merged([stand, tube(np.array([[0, 0, 1.35], [0, 0, 1.7]]), np.array([0.24, 0.14]), sides=16)])


def _straight(start: tuple, velocity_m_per_s: tuple, yaw: float) -> Path:
    """Steady motion from `start`, the thing's x axis turned by `yaw`."""
    return lambda time_s: pose.from_yaw(yaw, np.array(start) + np.array(velocity_m_per_s) * time_s)


def _hand_held(rng: np.random.Generator) -> Path:
    """A camera in a hand: a few decimetres and ten-odd degrees a second, to and fro, along x at first."""
    begin = pose.from_translation(np.array(_EYE)) @ pose.exp(np.array([0, _LOOKS_DOWN, 0, 0, 0, 0]))
    amplitude = np.array([0.05, 0.06, 0.07, 0.08, 0.10, 0.06])     # radians, then metres
    frequency = 2 * np.pi * rng.uniform(0.35, 0.6, (2, 6))
    phase = rng.uniform(0, 2 * np.pi, (2, 6))

    def twist(time_s: float) -> np.ndarray:
        return (amplitude * np.sin(frequency * time_s + phase)).mean(axis=0)

    at_start = twist(0.0)
    return lambda time_s: begin @ pose.exp(twist(time_s) - at_start)

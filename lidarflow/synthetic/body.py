"""The pieces of a human figure of 1.75 m, to be scaled, and the joints between them.

x forward, y left, z up, metres; the figure stands at z = 0.
"""

from collections.abc import Callable

import numpy as np

from lidarflow import pose
from lidarflow.synthetic.scene import Path
from lidarflow.synthetic.shapes import Mesh, box, ellipsoid, loft, merged, squircle, tube

HIP = (0.0, 0.09, 0.90)
SHOULDER = (0.0, 0.24, 1.40)
ELBOW = (0.0, 0.02, -0.28)   # from the shoulder
TRUNK_M = (0.84, 1.54)       # heights over ground of the crotch and of the neck's upper end

# Height over ground [m], half the depth along x, half the width along y.
_TRUNK = np.array([
    (0.84, 0.10, 0.15), (0.95, 0.13, 0.18), (1.10, 0.11, 0.15), (1.28, 0.13, 0.19), (1.42, 0.10, 0.20),
    (1.49, 0.06, 0.08), (1.54, 0.05, 0.06)])
# Hangs from the shoulder, the elbow a little bent.
_ARM = np.array([[0, 0, 0.04], [0, 0, 0], ELBOW, [0.08, 0.02, -0.54], [0.10, 0.02, -0.64]])
_ARM_RADII = np.array([0.04, 0.055, 0.045, 0.035, 0.04])


def hinged(world_from_parent: Path, joint: np.ndarray, turn: Callable[[float], np.ndarray]) -> Path:
    """The path of a limb that hangs from its parent at `joint` (3,), metres in the parent's frame.

    `turn` gives its rotation vector (3,) in radians at a time in seconds.
    """

    def world_from_limb(time_s: float) -> np.ndarray:
        twist = np.concatenate([turn(time_s), np.zeros(3)])
        return world_from_parent(time_s) @ pose.from_translation(joint) @ pose.exp(twist)

    return world_from_limb


def trunk(scale: float, low: float = TRUNK_M[0], high: float = TRUNK_M[1]) -> Mesh:
    """The trunk between two heights over ground, of a figure that is not yet scaled."""
    heights = np.concatenate([[low], _TRUNK[(_TRUNK[:, 0] > low) & (_TRUNK[:, 0] < high), 0], [high]])
    sections = []
    for z in heights:
        half_depth, half_width = (np.interp(z, _TRUNK[:, 0], _TRUNK[:, column]) for column in (1, 2))
        ring = squircle(half_depth, half_width, exponent=2.6, count=14)
        sections.append(np.column_stack([ring, np.full(len(ring), z)]))
    return _scaled(loft(np.stack(sections)), scale)


def head(scale: float) -> Mesh:
    """The head, over the trunk."""
    return _scaled(ellipsoid((0.02, 0.0, 1.64), (0.10, 0.08, 0.125)), scale)


def arm(scale: float) -> Mesh:
    """Hangs from the shoulder at the origin."""
    return tube(_ARM * scale, _ARM_RADII * scale, sides=8)


def upper_arm(scale: float) -> Mesh:
    """Hangs from the shoulder at the origin."""
    return tube(_ARM[:3] * scale, _ARM_RADII[:3] * scale, sides=8)


def forearm(scale: float) -> Mesh:
    """Hangs from the elbow at the origin, with the hand."""
    return tube((_ARM[2:] - ELBOW) * scale, _ARM_RADII[2:] * scale, sides=8)


def leg(scale: float) -> Mesh:
    """Hangs from the hip at the origin, 0.9 m down to the sole."""
    line = np.array([[0, 0, 0.02], [0, 0, -0.20], [0.01, 0, -0.44], [0, 0, -0.62], [0, 0, -0.86]])
    limb = tube(line * scale, np.array([0.09, 0.085, 0.06, 0.06, 0.045]) * scale, sides=8)
    foot = box((0.26 * scale, 0.09 * scale, 0.07 * scale), (0.06 * scale, 0.0, -0.865 * scale))
    return merged([limb, foot])


def _scaled(mesh: Mesh, scale: float) -> Mesh:
    return Mesh(mesh.vertices * scale, mesh.triangles)

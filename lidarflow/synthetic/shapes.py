"""Triangle meshes of simple shapes; x forward, y left, z up, metres."""

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from lidarflow import pose


@dataclass(frozen=True, slots=True, eq=False)
class Mesh:
    """A triangle mesh.

    vertices   (V, 3) float64   metres
    triangles  (T, 3) int64     rows of `vertices`
    """

    vertices: np.ndarray
    triangles: np.ndarray

    def __post_init__(self):
        for name in ("vertices", "triangles"):
            shape = getattr(self, name).shape
            if len(shape) != 2 or shape[1] != 3:
                raise ValueError(f"Mesh.{name}: expected (N, 3), got {shape}")
        if len(self.triangles) and not 0 <= self.triangles.min() <= self.triangles.max() < len(self.vertices):
            raise ValueError(f"Mesh.triangles: indices must lie in 0..{len(self.vertices) - 1}")


def merged(meshes: Iterable[Mesh]) -> Mesh:
    """One mesh of several."""
    meshes = list(meshes)
    first_vertex = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes])[:-1]
    triangles = [mesh.triangles + first for mesh, first in zip(meshes, first_vertex, strict=True)]
    return Mesh(np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(triangles))


def moved(mesh: Mesh, motion: np.ndarray) -> Mesh:
    """The mesh moved by a rigid motion (4, 4)."""
    return Mesh(pose.apply(motion, mesh.vertices), mesh.triangles)


def shifted(mesh: Mesh, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Mesh:
    """The mesh moved by a translation in metres."""
    return Mesh(mesh.vertices + np.array([x, y, z]), mesh.triangles)


def sheet(grid: np.ndarray) -> Mesh:
    """A surface through a grid (A, B, 3) of points."""
    rows, columns = grid.shape[:2]
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    triangles = np.stack([a, b, c, a, c, d], axis=-1).reshape(-1, 3)
    return Mesh(grid.reshape(-1, 3), triangles)


def loft(sections: np.ndarray) -> Mesh:
    """A closed body through closed rings of points (K, V, 3), capped at both ends."""
    closed = np.concatenate([sections, sections[:, :1]], axis=1)
    ends = [sections[0], sections[-1]]
    caps = []
    for ring in ends:
        count = len(ring)
        index = np.arange(count)
        fan = np.stack([index, (index + 1) % count, np.full(count, count)], axis=1)
        caps.append(Mesh(np.concatenate([ring, ring.mean(axis=0, keepdims=True)]), fan))
    return merged([sheet(closed), *caps])


def box(size: tuple[float, float, float], centre: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Mesh:
    """An upright box of `size` around `centre`, metres."""
    corner = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) / 2
    rings = np.stack([np.column_stack([corner, np.full(4, z)]) for z in (-0.5, 0.5)])
    return loft(rings * np.array(size) + np.array(centre))


def squircle(half_width: float, half_height: float, exponent: float = 4.0, count: int = 20) -> np.ndarray:
    """Points (count, 2) on a rounded rectangle, |u/half_width|ⁿ + |v/half_height|ⁿ = 1."""
    angle = (np.arange(count) + 0.5) * (2 * np.pi / count)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return np.sign(circle) * np.abs(circle) ** (2.0 / exponent) * np.array([half_width, half_height])


def tube(line: np.ndarray, radii: np.ndarray, sides: int = 10) -> Mesh:
    """A tube around a polyline (K, 3) with radii (K,), metres."""
    line, radii = np.asarray(line, float), np.asarray(radii, float)
    direction = np.gradient(line, axis=0)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    helper = np.eye(3)[np.argmin(np.abs(direction).sum(axis=0))]
    u = np.cross(direction, helper)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    v = np.cross(direction, u)
    angle = np.arange(sides) * (2 * np.pi / sides)
    around = np.cos(angle)[:, None] * u[:, None] + np.sin(angle)[:, None] * v[:, None]
    return loft(line[:, None] + radii[:, None, None] * around)


def ellipsoid(centre: tuple[float, float, float], radii: tuple[float, float, float], count: int = 10) -> Mesh:
    """An ellipsoid with `count` rings of `count` points."""
    latitude = np.linspace(-np.pi / 2, np.pi / 2, count + 2)[1:-1]
    angle = np.arange(count) * (2 * np.pi / count)
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    rings = [np.column_stack([np.cos(a) * ring, np.full(count, np.sin(a))]) for a in latitude]
    return loft(np.stack(rings) * np.array(radii) + np.array(centre))


def relief(x_edges: np.ndarray, z_edges: np.ndarray, depth: np.ndarray) -> Mesh:
    """A wall that looks to -y: grid cell (i, j) lies `depth[i, j]` metres behind y = 0, steps closed."""
    quads = []
    for i, (x0, x1) in enumerate(pairwise(x_edges)):
        for j, (z0, z1) in enumerate(pairwise(z_edges)):
            y = depth[i, j]
            quads.append([[x0, y, z0], [x1, y, z0], [x1, y, z1], [x0, y, z1]])
            if i and depth[i - 1, j] != y:
                before = depth[i - 1, j]
                quads.append([[x0, before, z0], [x0, y, z0], [x0, y, z1], [x0, before, z1]])
            if j and depth[i, j - 1] != y:
                below = depth[i, j - 1]
                quads.append([[x0, below, z0], [x1, below, z0], [x1, y, z0], [x0, y, z0]])
    first = 4 * np.arange(len(quads))[:, None]
    triangles = np.concatenate([first + [0, 1, 2], first + [0, 2, 3]])
    return Mesh(np.array(quads).reshape(-1, 3), triangles)


def facets(centres: np.ndarray, size_m: float, rng: np.random.Generator) -> Mesh:
    """Single triangles of about `size_m` at `centres` (N, 3), turned at random: foliage."""
    corners = rng.normal(size=(len(centres), 3, 3))
    length_m = size_m * rng.uniform(0.5, 1.0, (len(centres), 1, 1))
    corners *= length_m / np.linalg.norm(corners, axis=2, keepdims=True)
    vertices = (centres[:, None] + corners).reshape(-1, 3)
    return Mesh(vertices, np.arange(len(vertices)).reshape(-1, 3))

"""What lines a street: buildings, fences, hedges, trees, poles, signs; fronts look to -y, feet at z = 0."""

import numpy as np

from lidarflow import pose
from lidarflow.synthetic.shapes import Mesh, box, ellipsoid, facets, merged, moved, relief, shifted, tube

_STOREY_M = 3.1
_FOUNDATION_M = 0.5


def building(width: float, depth: float, rng: np.random.Generator) -> Mesh:
    """A house, centred in x, with its front at y = 0: windows, door, plinth, ledges, balconies, downpipe."""
    storeys = int(rng.integers(2, 5))
    front = facade(width, storeys, True, rng)
    side = facade(depth, storeys, False, rng)
    height = storeys * _STOREY_M + 0.6
    left = moved(side, pose.from_yaw(-np.pi / 2, np.array([-width / 2, depth / 2, 0.0])))
    right = moved(side, pose.from_yaw(np.pi / 2, np.array([width / 2, depth / 2, 0.0])))
    core = box((width - 1.2, depth - 1.2, height + _FOUNDATION_M - 0.2),
               (0.0, depth / 2, (height - _FOUNDATION_M) / 2))
    pipe_x = width / 2 - rng.uniform(0.25, 0.6)
    pipe = tube(np.array([[pipe_x, -0.10, 0.0], [pipe_x, -0.10, height]]), np.full(2, 0.055), sides=8)
    eaves = box((width + 0.5, depth + 0.5, 0.25), (0.0, depth / 2, height))
    return merged([front, left, right, core, pipe, eaves])


def facade(width: float, storeys: int, has_door: bool, rng: np.random.Generator) -> Mesh:
    """A wall centred in x with recessed windows, ledges and, where wanted, a door and balconies."""
    bays = max(2, round(width / rng.uniform(2.4, 3.4)))
    window_width, recess = rng.uniform(0.9, 1.4), rng.uniform(0.15, 0.30)
    bay = width / bays
    sides = (np.arange(bays)[:, None] + 0.5) * bay + np.array([-0.5, 0.5]) * window_width - width / 2
    x_edges = np.concatenate([[-width / 2], sides.ravel(), [width / 2]])
    sill = rng.uniform(0.8, 1.1)
    levels = [-_FOUNDATION_M, 0.45]
    for storey in range(storeys):
        floor = storey * _STOREY_M
        levels += [floor + sill, floor + 2.35, floor + _STOREY_M - 0.2, floor + _STOREY_M]
    z_edges = np.array([*levels, storeys * _STOREY_M + 0.6])

    depth = np.zeros((len(x_edges) - 1, len(z_edges) - 1))
    depth[:, 0] = -0.05
    is_window_row = np.zeros(len(z_edges) - 1, bool)
    is_window_row[2:-1:4] = True
    depth[1::2, is_window_row] = recess
    depth[:, 4:-1:4] = -0.06
    pieces = []
    if has_door:
        door = 1 + 2 * int(rng.integers(bays))
        depth[door, :3] = rng.uniform(0.30, 0.50)
        pieces.append(box((window_width, 0.4, 0.30), (x_edges[door : door + 2].mean(), 0.2, 0.0)))
        pieces += _balconies(sides.mean(axis=1), window_width, storeys, rng)
    pieces += [box((window_width + 0.2, 0.16, 0.06), (x, -0.04, storey * _STOREY_M + sill))
               for x in sides.mean(axis=1) for storey in range(1, storeys)]
    return merged([relief(x_edges, z_edges, depth), *pieces])


def _balconies(
    centres_x: np.ndarray, window_width: float, storeys: int, rng: np.random.Generator
) -> list[Mesh]:
    pieces = []
    for x in centres_x:
        for storey in range(1, storeys):
            if rng.random() > 0.25:
                continue
            floor, span = storey * _STOREY_M, window_width + 0.7
            pieces.append(box((span, 1.0, 0.15), (x, -0.5, floor)))
            pieces.append(box((span, 0.05, 0.75), (x, -0.97, floor + 0.55)))
            pieces += [box((0.05, 1.0, 0.06), (x + side * span / 2, -0.5, floor + 0.9)) for side in (-1, 1)]
    return pieces


def fence(length: float) -> Mesh:
    """Pickets on two rails between posts, 1.1 m high, centred in x."""
    pickets = [box((0.09, 0.025, 1.0), (x, 0.0, 0.6)) for x in np.arange(-length / 2, length / 2, 0.22)]
    posts = [box((0.12, 0.12, 1.25), (x, 0.06, 0.6)) for x in np.linspace(-length / 2, length / 2, 4)]
    rails = [box((length, 0.05, 0.09), (0.0, 0.04, z)) for z in (0.35, 0.9)]
    return merged(pickets + posts + rails)


def hedge(length: float, rng: np.random.Generator) -> Mesh:
    """A clipped hedge, 1.4 m high, of leaf facets over a dark core, centred in x."""
    size = np.array([length, 0.8, 1.4])
    count = int(110 * length)
    centres = rng.uniform(-0.5, 0.5, (count, 3))
    axis = rng.choice(3, size=count, p=[0.05, 0.6, 0.35])
    rows = np.arange(count)
    centres[rows, axis] = 0.5 * np.where(centres[rows, axis] < 0, -1, 1)
    centres = centres * size + rng.normal(scale=0.05, size=(count, 3)) + [0, 0, 0.72]
    return merged([box((length - 0.1, 0.6, 1.3), (0, 0, 0.65)), facets(centres, 0.14, rng)])


def tree(rng: np.random.Generator, crown_m: float = 1.9) -> Mesh:
    """A bent trunk, a few branches and an irregular crown of leaf facets that begins at about `crown_m`."""
    spread = rng.uniform(1.1, 1.8)
    height = crown_m + 1.1 * spread
    bend = np.cumsum(rng.normal(scale=0.06, size=(5, 2)), axis=0)
    trunk = np.column_stack([bend - bend[0], np.linspace(-0.2, height, 5)])
    pieces = [tube(trunk, np.linspace(0.18, 0.07, 5), sides=8)]
    clumps = int(rng.integers(5, 9))
    for _ in range(clumps):
        direction = rng.normal(size=3)
        offset = direction / np.linalg.norm(direction) * rng.uniform(0.3, 0.8) * spread
        centre = trunk[-1] + offset * np.array([1.0, 1.0, 0.8])
        pieces.append(tube(np.array([trunk[-2], centre]), np.array([0.06, 0.03]), sides=5))
        shell = rng.normal(size=(90, 3))
        shell *= rng.uniform(0.5, 1.0, (90, 1)) / np.linalg.norm(shell, axis=1, keepdims=True)
        pieces.append(facets(centre + shell * spread * rng.uniform(0.4, 0.65), 0.22, rng))
    return merged(pieces)


def bush(rng: np.random.Generator) -> Mesh:
    """A knee- to chest-high bush of leaf facets."""
    radius = rng.uniform(0.4, 0.8)
    shell = rng.normal(size=(140, 3))
    shell *= rng.uniform(0.6, 1.0, (140, 1)) / np.linalg.norm(shell, axis=1, keepdims=True)
    core = ellipsoid((0, 0, radius * 0.8), (radius * 0.6, radius * 0.6, radius * 0.7))
    return merged([core, facets(shell * radius + [0, 0, radius * 0.9], 0.14, rng)])


def lamp() -> Mesh:
    """A street lamp whose arm reaches to -y."""
    line = np.array([[0, 0, -0.2], [0, 0, 1.0], [0, 0, 1.05], [0, 0, 7.0]])
    mast = tube(line, np.array([0.11, 0.11, 0.07, 0.05]))
    arm = tube(np.array([[0, 0, 6.9], [0, -1.6, 7.1]]), np.full(2, 0.04), sides=6)
    return merged([mast, arm, box((0.25, 0.6, 0.12), (0, -1.7, 7.08))])


def sign(rng: np.random.Generator) -> Mesh:
    """A traffic sign, round or square, that looks along x."""
    post = tube(np.array([[0, 0, -0.2], [0, 0, 2.7]]), np.full(2, 0.035), sides=8)
    z = rng.uniform(2.2, 2.5)
    if rng.random() < 0.5:
        plate = tube(np.array([[-0.06, 0, z], [-0.04, 0, z]]), np.full(2, 0.32), sides=16)
    else:
        plate = box((0.02, 0.6, 0.6), (-0.05, 0.0, z))
    return merged([post, plate])


def litter_bin() -> Mesh:
    """A round bin on the pavement."""
    return shifted(tube(np.array([[0, 0, -0.1], [0, 0, 0.8], [0, 0, 0.95]]), np.array([0.22, 0.26, 0.12])))

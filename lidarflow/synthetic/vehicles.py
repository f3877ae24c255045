"""Cars and vans: lofted bodies with wheels and mirrors; x forward, origin on the ground below the middle."""

import numpy as np

from lidarflow.synthetic.shapes import Mesh, box, loft, merged, squircle, tube

# Stations of a body from tail to nose: share of half the length, of the width, sill and top over ground [m].
_SEDAN_HULL = ((-1.0, 0.80, 0.42, 0.78), (-0.95, 0.94, 0.28, 0.98), (-0.75, 1.00, 0.24, 1.02),
               (0.30, 1.00, 0.22, 0.96), (0.62, 0.98, 0.22, 0.90), (0.90, 0.90, 0.24, 0.76),
               (1.0, 0.74, 0.36, 0.62))
_HATCH_HULL = ((-1.0, 0.84, 0.40, 0.88), (-0.96, 0.95, 0.28, 1.02), (-0.70, 1.00, 0.24, 1.02),
               (0.38, 1.00, 0.22, 0.98), (0.66, 0.98, 0.22, 0.92), (0.92, 0.90, 0.24, 0.78),
               (1.0, 0.76, 0.36, 0.64))
_VAN_HULL = ((-1.0, 0.94, 0.40, 1.90), (-0.97, 0.98, 0.30, 2.05), (-0.80, 1.00, 0.28, 2.10),
             (0.35, 1.00, 0.28, 2.08), (0.52, 0.97, 0.28, 1.95), (0.74, 0.96, 0.28, 1.18),
             (0.95, 0.90, 0.30, 0.98), (1.0, 0.80, 0.38, 0.80))
# Levels of a cabin from belt line to roof: share of its height, tail and nose in half lengths, width share.
_SEDAN_CABIN = ((0.0, -0.72, 0.48, 0.92), (0.55, -0.58, 0.26, 0.84),
                (0.92, -0.40, 0.08, 0.72), (1.0, -0.34, 0.0, 0.62))
_HATCH_CABIN = ((0.0, -0.97, 0.54, 0.92), (0.55, -0.90, 0.32, 0.84),
                (0.92, -0.78, 0.12, 0.74), (1.0, -0.70, 0.04, 0.64))


def car(rng: np.random.Generator) -> Mesh:
    """A car (sedan or hatchback) of random proportions, about 4.3 x 1.8 x 1.5 m."""
    width = rng.uniform(1.70, 1.86)
    if rng.random() < 0.5:
        hull, cabin = _SEDAN_HULL, _SEDAN_CABIN
        length, height = rng.uniform(4.3, 4.8), rng.uniform(1.42, 1.50)
    else:
        hull, cabin = _HATCH_HULL, _HATCH_CABIN
        length, height = rng.uniform(3.8, 4.3), rng.uniform(1.46, 1.62)
    body = [_hull(hull, length, width), _cabin(cabin, length, width, 0.92, height)]
    mirrors = [box((0.12, 0.20, 0.14), (0.21 * length, side * (width / 2 + 0.06), 0.98)) for side in (-1, 1)]
    return merged(body + mirrors + _wheels(length * 0.30, width, 0.32))


def van(rng: np.random.Generator) -> Mesh:
    """A delivery van of random proportions, about 5.4 x 2 x 2.1 m."""
    length, width = rng.uniform(5.1, 5.7), rng.uniform(1.95, 2.05)
    mirrors = [box((0.12, 0.22, 0.30), (0.29 * length, side * (width / 2 + 0.09), 1.35)) for side in (-1, 1)]
    rail = box((0.4 * length, 0.05, 0.06), (-0.25 * length, width / 2 + 0.01, 1.1))
    return merged([_hull(_VAN_HULL, length, width), rail, *mirrors, *_wheels(length * 0.31, width, 0.36)])


def _hull(stations: tuple, length: float, width: float) -> Mesh:
    """Rounded cross-sections along x."""
    sections = []
    for x_share, width_share, low, top in stations:
        ring = squircle(width_share * width / 2, (top - low) / 2, exponent=5.0)
        x = np.full(len(ring), x_share * length / 2)
        sections.append(np.column_stack([x, ring[:, 0], ring[:, 1] + (low + top) / 2]))
    return loft(np.stack(sections))


def _cabin(levels: tuple, length: float, width: float, belt_m: float, height: float) -> Mesh:
    """Rounded outlines stacked along z."""
    sections = []
    for share, tail, nose, width_share in levels:
        ring = squircle((nose - tail) * length / 4, width_share * width / 2, exponent=6.0)
        z = np.full(len(ring), belt_m + share * (height - belt_m))
        sections.append(np.column_stack([ring[:, 0] + (nose + tail) * length / 4, ring[:, 1], z]))
    return loft(np.stack(sections))


def _wheels(axle_m: float, width: float, radius: float) -> list[Mesh]:
    """Four wheels, a little proud of the body."""
    wheels = []
    for x in (-axle_m, axle_m):
        for side in (-1, 1):
            inner, outer = side * (width / 2 - 0.20), side * (width / 2 + 0.03)
            line = np.array([[x, inner, radius], [x, outer, radius]])
            wheels.append(tube(line, np.full(2, radius), sides=16))
    return wheels

"""Whether z is up in a scan: the ground, and what stands on it, are looked for along z."""

import numpy as np

from lidarflow.rows import every_few

_SAMPLE = 3000             # points, and normals; they tell shares to 0.01
_NEAREST_M, _FARTHEST_M = 1.0, 30.0
_FLAT = 2.9                # times wider across than along: 3.3 or more of streets, 2.5 of a narrow corridor
_LINE = 1e-6               # the share of squares across it of what is but a line
_ANOTHER_AXIS = 0.7        # cosine of 45 degrees: what is flat farther from z is flat along another axis
_ALIKE = 0.966             # cosine of 15 degrees between normals of one surface that rises and falls
_UPRIGHT = 0.5             # cosine of 60 degrees: what is steeper than this is a wall
_LEAST_LEAN_DEG = 20.0     # a sensor that nods stays below
_LEAST_SHARE = 0.1         # of all surfaces; the ground is 0.13 or more of them
_CLEARLY_MORE = 3.0        # times what is level: 1.6 at most where z is up, most often 5 when 30 degrees off
_CANDIDATES = 48
_ADVICE = "expected z up, turn the clouds"


def doubt(points: np.ndarray, normals: np.ndarray) -> str:
    """Why z is hardly up in a scan, in one line; "" where it may be.

    points   (N, 3)  metres, sensor frame, of which some may be NaN
    normals  (M, 3)  of its surfaces, ground and all, thinned evenly; NaN where there is none

    Most scans are flat: along z, if that is up. And much of them is ground, whose normals are about z. Clouds
    that are upside down are not noticed: they are as those of a sensor below a ceiling.
    """
    axis = _wrong_flat_axis(_some(points))
    if axis:
        return f"the cloud is flat along {axis}; {_ADVICE}"
    lean_deg = _lean_deg(_some(normals))
    return f"the ground leans by {lean_deg:.0f} degrees; {_ADVICE}" if lean_deg else ""


def _some(rows: np.ndarray) -> np.ndarray:
    """Some of the rows (N, 3), evenly over their order, but those that are NaN."""
    some = rows[every_few(len(rows), _SAMPLE)]
    return some[np.isfinite(some[:, 0])]


def _wrong_flat_axis(points: np.ndarray) -> str:
    """The axis, "x" or "y", nearest to which points (N, 3) are flat; "" where that is z, or there is none.

    Seen from the sensor: a wall before it is flat along its normal, but far off along that as well.
    """
    with np.errstate(over="ignore"):
        range_sq = np.einsum("ij,ij->i", points, points)
    near = points[(range_sq > _NEAREST_M**2) & (range_sq < _FARTHEST_M**2)]
    squares, directions = np.linalg.eigh(near.T @ near)
    if squares[1] <= max(_FLAT**2 * squares[0], _LINE * squares[2]):
        return ""
    x, y, z = np.abs(directions[:, 0])
    return "" if z > _ANOTHER_AXIS else "x" if x > y else "y"


def _lean_deg(normals: np.ndarray) -> float:
    """How far from level the surface is that most of the normals (M, 3) are of; walls are left out.

    0 where it leans little, or is hardly more than what is level.
    """
    upward = normals * np.where(normals[:, 2:] < 0, -1.0, 1.0)
    rising = upward[upward[:, 2] > _UPRIGHT]
    least = max(1.0, _LEAST_SHARE * len(normals), _CLEARLY_MORE * np.count_nonzero(rising[:, 2] > _ALIKE))
    if len(rising) < least:
        return 0.0
    candidates = rising[every_few(len(rising), _CANDIDATES)]
    best = candidates[np.count_nonzero(rising @ candidates.T > _ALIKE, axis=0).argmax()]
    mean = rising[rising @ best > _ALIKE].mean(axis=0)
    mean /= np.linalg.norm(mean)
    lean_deg = float(np.degrees(np.arccos(min(1.0, mean[2]))))
    is_clear = np.count_nonzero(rising @ mean > _ALIKE) >= least and lean_deg >= _LEAST_LEAN_DEG
    return lean_deg if is_clear else 0.0

"""Rigid motion of a small group of points onto the next scan, turning about the vertical only."""

import numpy as np
from scipy.spatial import cKDTree

from lidarflow import pose, robust
from lidarflow.lidar.surface import Surface, counterparts

_GATES_M = (1.0, 0.5, 0.3)   # how far a point may be from its counterpart, coarse to fine
_ROUNDS_PER_GATE = 5
_PLANE_GATES_M = (0.5,) * 5 + (0.3,) * 10
_MAX_TURN_RAD = 0.15
_MIN_TURNING_POINTS = 16     # fewer points do not fix a turn
_MIN_POINTS = 4
_SETTLED = 1e-4              # a round that changes less, in metres and radians, ends its gate
_PLANE_SCALE_M = 0.05        # plane distances beyond it lose weight
_POINT_SCALE_M = 0.15        # and distances between points beyond this
_POINT_WEIGHT = 0.05         # of a pair of points, where the plane of the same pair has 1


def onto(points: np.ndarray, target: cKDTree, translation: np.ndarray) -> np.ndarray:
    """Motion (4, 4) of points (N, 3) onto the points of `target`, by ICP in yaw and translation.

    It starts from `translation` (3,) in metres. What stands upright on the ground turns about the vertical.
    """
    centre = points.mean(axis=0)
    turn, shift = 0.0, np.asarray(translation, float)
    for gate_m in _GATES_M:
        for _ in range(_ROUNDS_PER_GATE):
            moved = pose.apply(_about(centre, turn, shift), points)
            distance_m, nearest = target.query(moved, distance_upper_bound=gate_m)
            paired = np.isfinite(distance_m)
            if paired.sum() < _MIN_POINTS:
                break
            before = turn, shift
            turn, shift = _best(points[paired] - centre, target.data[nearest[paired]] - centre)
            if abs(turn - before[0]) < _SETTLED and np.abs(shift - before[1]).max() < _SETTLED:
                break
    return _about(centre, turn, shift)


def onto_planes(
    points: np.ndarray, normals: np.ndarray, target: Surface, tree: cKDTree, start: np.ndarray,
    up: np.ndarray, along_ground: float,
) -> np.ndarray:
    """Motion (4, 4) of points (N, 3) with normals (N, 3) onto a surface, by robust point-to-plane ICP.

    Rings of a spinning sensor stand still on a body that moves under them; nearest points follow the rings,
    planes do not. A small weight on the points themselves holds what no plane does. What drives or walks
    moves along the ground: the shift along its normal `up` (3,) is held back with `along_ground` times the
    weight of all pairs. Turns are about the vertical; `start` (4, 4) is one.
    """
    centre = points.mean(axis=0)
    turn = float(np.arctan2(start[1, 0], start[0, 0]))
    shift = pose.apply(start, centre[None])[0] - centre
    for gate_m in _PLANE_GATES_M:
        step = _plane_step(
            points - centre, normals, centre, turn, shift, target, tree, gate_m, up, along_ground)
        if step is None:
            break
        turn = float(np.clip(turn + step[0], -_MAX_TURN_RAD, _MAX_TURN_RAD))
        shift = shift + step[1:]
        if np.abs(step).max() < _SETTLED and gate_m == _PLANE_GATES_M[-1]:
            break
    return _about(centre, turn, shift)


def _plane_step(
    from_centre: np.ndarray, normals: np.ndarray, centre: np.ndarray, turn: float, shift: np.ndarray,
    target: Surface, tree: cKDTree, gate_m: float, up: np.ndarray, along_ground: float,
) -> np.ndarray | None:
    """Change (4,) of turn and shift by one Gauss-Newton step; None without enough pairs."""
    rotation = pose.from_yaw(turn)
    turned = pose.apply(rotation, from_centre)
    row, distance_m, agrees = counterparts(
        turned + centre + shift, pose.turn(rotation, normals), target, tree, gate_m)
    paired = np.isfinite(distance_m)
    count = int(paired.sum())
    if count < _MIN_POINTS:
        return None
    row, agrees, x = row[paired], agrees[paired], turned[paired]
    off = target.points[row] - (x + centre + shift)
    jacobian = np.zeros((count, 3, 4))
    jacobian[:, 0, 0], jacobian[:, 1, 0] = -x[:, 1], x[:, 0]
    jacobian[:, :, 1:] = np.eye(3)

    plane = np.where(agrees[:, None], target.normals[row], 0.0)
    off_plane = (plane * off).sum(axis=1)
    plane_jacobian = np.einsum("ki,kij->kj", plane, jacobian)
    _, weight = robust.geman_mcclure(off_plane**2, _PLANE_SCALE_M)
    plane_weight = np.where(agrees, weight, 0.0)
    _, weight = robust.geman_mcclure((off**2).sum(axis=1), _POINT_SCALE_M)
    point_weight = _POINT_WEIGHT * weight
    matrix = (plane_jacobian * plane_weight[:, None]).T @ plane_jacobian
    matrix += np.einsum("k,kij,kil->jl", point_weight, jacobian, jacobian)
    right = plane_jacobian.T @ (plane_weight * off_plane)
    right += np.einsum("k,kij,ki->j", point_weight, jacobian, off)

    total = plane_weight.sum() + point_weight.sum()
    vertical = np.concatenate([[0.0], up])
    matrix += along_ground * total * np.outer(vertical, vertical)
    right -= along_ground * total * (up @ shift) * vertical
    if count < _MIN_TURNING_POINTS:
        matrix[0], matrix[:, 0], right[0] = 0.0, 0.0, 0.0
        matrix[0, 0] = 1.0
    return np.linalg.solve(matrix + 1e-6 * max(total, 1.0) * np.eye(4), right)


def _best(a: np.ndarray, b: np.ndarray) -> tuple[float, np.ndarray]:
    """Turn about z and shift that bring points a (K, 3) closest to b (K, 3) in least squares."""
    mean_a, mean_b = a.mean(axis=0), b.mean(axis=0)
    turn = 0.0
    if len(a) >= _MIN_TURNING_POINTS:
        from_mean_a, from_mean_b = (a - mean_a)[:, :2], (b - mean_b)[:, :2]
        sine = (from_mean_a[:, 0] * from_mean_b[:, 1] - from_mean_a[:, 1] * from_mean_b[:, 0]).sum()
        cosine = (from_mean_a * from_mean_b).sum()
        turn = float(np.clip(np.arctan2(sine, cosine), -_MAX_TURN_RAD, _MAX_TURN_RAD))
    return turn, mean_b - pose.apply(pose.from_yaw(turn), mean_a)


def _about(centre: np.ndarray, turn: float, shift: np.ndarray) -> np.ndarray:
    """Motion (4, 4) that turns about the vertical through `centre` (3,), then shifts."""
    return pose.from_translation(centre + shift) @ pose.from_yaw(turn) @ pose.from_translation(-centre)

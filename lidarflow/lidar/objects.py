"""Moving objects: neighbouring points with one rigid motion that clearly beats ego-motion."""

import numpy as np

from lidarflow import pose
from lidarflow.config import ObjectsConfig
from lidarflow.lidar import body, clusters, hypotheses, rigid_fit, seeds
from lidarflow.lidar.acceptance import moves
from lidarflow.lidar.body import Body
from lidarflow.lidar.surface import Misfit
from lidarflow.lidar.view import View
from lidarflow.types import MovingObject

_SEED_LINK_M = 0.7
_MIN_SEEDS = 5
_MAX_SHIFT_M = 3.0        # over ground and between scans: 30 m/s at 10 Hz
_MAX_START_RATIO = 0.7   # of the squared misfit that ego-motion leaves
_DISTANCE_WEIGHT = 0.3   # of squared distances to points, where those to planes have 1
_MAX_START_POINTS = 300  # as many choose the start; the fit that follows uses all


def find(
    view: View, dt_s: float, config: ObjectsConfig, expected: tuple[hypotheses.Expected, ...] = ()
) -> list[Body]:
    """The moving objects of a view; no point belongs to two, and the best supported come first.

    `expected` is what earlier pairs lead to expect: it is looked for where it should be, and believed no
    more easily than the rest.
    """
    found = seeds.find(view, [e.points for e in expected], config)
    label = clusters.linked(view.points[found.rows], _SEED_LINK_M)
    bodies, free = [], np.ones(len(view.points), bool)
    for cluster in np.argsort(-np.bincount(label), kind="stable") if len(label) else ():
        mine = (label == cluster) & free[found.rows]
        seed = found.rows[mine]
        if len(seed) < _MIN_SEEDS:
            continue
        start = _best_start(view, seed, found.shift[mine], expected)
        if start is None:
            continue
        grown = body.grown(view, seed, start, free, config)
        if grown is None or not moves(view, grown, dt_s, config):
            continue
        whole = body.completed(view, grown, free, config)
        # What a body surrounds must not speak against it.
        if moves(view, whole, dt_s, config):
            bodies.append(whole)
            free[whole.rows] = False
    return bodies


def describe(
    number: int, points: np.ndarray, motion: np.ndarray, ego_motion: np.ndarray, dt_s: float
) -> MovingObject:
    """The object of the source's points (K, 3) that moves by `motion` (4, 4), with a box along its way."""
    over_ground = (pose.apply(motion, points) - pose.apply(ego_motion, points)).mean(axis=0)
    along = pose.apply(pose.inverse(ego_motion), over_ground) - pose.inverse(ego_motion)[:3, 3]
    yaw = float(np.arctan2(along[1], along[0]))
    upright = pose.apply(pose.from_yaw(-yaw), points)
    low, high = upright.min(axis=0), upright.max(axis=0)
    centre = pose.apply(pose.from_yaw(yaw), (low + high) / 2.0)
    return MovingObject(number, motion, over_ground / dt_s, centre, high - low, yaw, len(points))


def _best_start(
    view: View, seed: np.ndarray, shift: np.ndarray, expected: tuple[hypotheses.Expected, ...]
) -> np.ndarray | None:
    """Motion (4, 4) of the seed rows that explains them best, of the translations proposed for them.

    None where none explains them clearly better than ego-motion does.
    """
    rows, shift = hypotheses.spread(seed, _MAX_START_POINTS), hypotheses.spread(shift, _MAX_START_POINTS)
    points = view.points[rows]
    fits = [rigid_fit.onto(points, view.upright_tree, translation)
            for translation in hypotheses.translations(view, rows, shift, expected, _MAX_SHIFT_M)]
    left_sq = [_misfit_sq(view.after(rows, fit)) for fit in fits]
    by_ego = Misfit(view.by_ego.distance_m[rows], view.by_ego.plane_m[rows])
    if not fits or min(left_sq) > _MAX_START_RATIO * _misfit_sq(by_ego):
        return None
    return fits[int(np.argmin(left_sq))]


def _misfit_sq(left: Misfit) -> float:
    return float((left.plane_m**2 + _DISTANCE_WEIGHT * left.distance_m**2).mean())

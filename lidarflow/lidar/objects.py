"""Moving objects: neighbouring points with one rigid motion that clearly beats ego-motion."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from lidarflow import pose
from lidarflow.aside import Each, one_by_one
from lidarflow.config import ObjectsConfig
from lidarflow.kernels import misfit as misfit_kernel
from lidarflow.lidar import body, hypotheses, rigid_fit, seeds
from lidarflow.lidar.acceptance import matches_agree, moves, seems_to_move
from lidarflow.lidar.body import Body, Growth
from lidarflow.lidar.surface import CAP_M, MIN_AGREEMENT, Misfit
from lidarflow.lidar.view import View
from lidarflow.rows import spread
from lidarflow.types import MovingObject

_MAX_SPEED_M_PER_S = 30.0  # over ground
_MAX_START_RATIO = 0.55  # of the squared misfit that ego-motion leaves; moving objects begin below 0.45
_MIN_START_SPEED = 0.5   # share of the least speed; points that follow the rings make a start too slow
_DISTANCE_WEIGHT = 0.3   # of squared distances to points, where those to planes have 1
_MAX_START_POINTS = 300  # as many choose the start; the fit that follows uses all


def find(
    view: View, found: seeds.Seeds, dt_s: float, config: ObjectsConfig,
    expected: hypotheses.Expected = hypotheses.NONE, each: Each = one_by_one,
) -> list[Body]:
    """The moving objects of a view, sought at seeds; no point belongs to two, the best supported come first.

    `expected` is what earlier pairs lead to expect: it is looked for where it should be, and believed no
    more easily than the rest, but that its surface need not face its motion where it clearly goes on as
    before. `each` judges candidates, several at a time if it can.
    """
    starts = _best_starts(view, found, found.clusters, expected, dt_s, config)
    bodies, free = [], np.ones(len(view.points), bool)
    # All are looked at as if each were alone; who meets what another has taken is looked at again.
    moving = [number for number, start in enumerate(starts) if start is not None]
    alone = dict(zip(moving, _candidates(
        view, [found.rows[found.clusters[number]] for number in moving],
        [starts[number] for number in moving], free, dt_s, config, expected, each), strict=True))
    taken = np.empty(0, np.int64)
    for number, (cluster, start) in enumerate(zip(found.clusters, starts, strict=True)):
        mine = cluster[free[found.rows[cluster]]]
        if len(mine) < len(cluster):
            start, = _best_starts(view, found, (mine,), expected, dt_s, config)
        if start is None:
            continue
        candidate = alone.get(number)
        if candidate is None or len(mine) < len(cluster) or candidate.asked[taken].any():
            candidate, = _candidates(view, [found.rows[mine]], [start], free, dt_s, config, expected, each)
        if candidate.body is not None:
            bodies.append(candidate.body)
            free[candidate.body.rows] = False
            taken = np.flatnonzero(~free)
    return bodies


def _candidates(
    view: View, seeds: list[np.ndarray], starts: list[np.ndarray], free: np.ndarray, dt_s: float,
    config: ObjectsConfig, expected: hypotheses.Expected, each: Each,
) -> list[Growth]:
    """What grows of seeds, rows (K,) each, over the rows that are `free` (N,), and moves."""
    grown = body.grown(view, seeds, starts, free, _least_shift_m(dt_s, config), config)
    grown = _those(grown, lambda own: seems_to_move(view, own, dt_s, config, expected), each)
    _match_at_once(view, grown)
    grown = _those(grown, lambda own: matches_agree(view, own, config), one_by_one)
    grown = each(lambda growth: body.completed(view, growth, free), grown)
    _match_at_once(view, grown)
    # What a body surrounds must not speak against it.
    return _those(grown, lambda own: moves(view, own, dt_s, config, expected), each)


def _those(growths: list[Growth], holds: Callable[[Body], bool], each: Each) -> list[Growth]:
    """The growths, without the bodies for which something does not hold."""
    there = [number for number, growth in enumerate(growths) if growth.body is not None]
    kept = list(growths)
    for number, answer in zip(there, each(holds, [growths[number].body for number in there]), strict=True):
        if not answer:
            kept[number] = replace(growths[number], body=None)
    return kept


def _match_at_once(view: View, growths: list[Growth]) -> None:
    """Have the view find matches that will be asked for one body after the other: together they take less."""
    rows = [growth.body.rows for growth in growths if growth.body is not None]
    if rows:
        view.matches(np.concatenate(rows))


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


def _best_starts(
    view: View, found: seeds.Seeds, clusters: tuple[np.ndarray, ...],
    expected: hypotheses.Expected, dt_s: float, config: ObjectsConfig,
) -> list[np.ndarray | None]:
    """For each cluster of seeds, the motion (4, 4) that explains it best, from what is proposed for it.

    None where there are too few seeds, none explains them clearly better than ego-motion does, or the one
    that does moves them too little along the ground to be looked at further.
    """
    chosen = [spread(cluster, _MAX_START_POINTS) for cluster in clusters]
    rows = [found.rows[cluster] for cluster in chosen]
    proposed = [
        (number, translation) for number, cluster in enumerate(chosen) if len(cluster) >= seeds.MIN_SEEDS
        for translation in hypotheses.translations(
            view, rows[number], found.shift[cluster], expected, _MAX_SPEED_M_PER_S * dt_s)]
    if not proposed:
        return [None] * len(clusters)
    fits = rigid_fit.onto([view.points[own] for own in rows], proposed, view.upright.tree)
    group = np.array([number for number, _ in proposed])
    left_sq = misfit_kernel.mean_sq_after(
        view.points, view.source.normals, *rigid_fit.concatenated(rows), group, fits, view.upright.tree,
        view.upright.normals, view.ground, CAP_M, MIN_AGREEMENT, _DISTANCE_WEIGHT)
    best: list[np.ndarray | None] = [None] * len(clusters)
    for number, own in enumerate(rows):
        mine = np.flatnonzero(group == number)
        if len(mine) and left_sq[mine].min() <= _MAX_START_RATIO * _misfit_sq(view.by_ego[own]):
            start = fits[mine[np.argmin(left_sq[mine])]]
            if _along_ground_m(view.points[own].mean(axis=0), start) >= _least_shift_m(dt_s, config):
                best[number] = start
    return best


def _along_ground_m(place: np.ndarray, motion: np.ndarray) -> float:
    """How far along the ground a motion (4, 4) takes a place (3,)."""
    shift = pose.apply(motion, place[None])[0] - place
    return float(np.hypot(shift[0], shift[1]))


def _least_shift_m(dt_s: float, config: ObjectsConfig) -> float:
    """How far along the ground a body must move to be looked at further."""
    return _MIN_START_SPEED * config.min_speed_m_per_s * dt_s


def _misfit_sq(left: Misfit) -> float:
    return float((left.plane_m**2 + _DISTANCE_WEIGHT * left.distance_m**2).mean())

"""The points of one moving body: grown from a seed over what agrees with its motion, then completed."""

from dataclasses import dataclass

import numpy as np

from lidarflow.config import ObjectsConfig
from lidarflow.kernels import grid, ground_plane, links, neighbours, tree
from lidarflow.lidar import rigid_fit
from lidarflow.lidar.view import View

_LINK_M = 0.5            # points of one body hang together at this distance
_FIRST_REACH_M = 1.0     # a body grows by this much at first,
_REACH_M = 0.7           # then by this much at a time
_GROWTH_ROUNDS = 5
_CLEARLY_BETTER_M = 0.02
_AS_GOOD_M = 0.03
_SURROUND_M = 0.35       # whose neighbours at this distance are mostly of the body belongs to it
_FRAGMENT_M = 1.0        # a fragment this near that follows the body belongs to it: glass returns nothing
_FIT_VOXEL_M = 0.12
_THIN_FIT_POINTS = 40
_SLOPE_RADIUS_M = 5.0
_MIN_SLOPE_POINTS = 20
_MAX_SLOPE = 0.2


@dataclass(frozen=True, slots=True, eq=False)
class Body:
    """Points that move as one.

    rows         (K,) int64     rows of the view's points
    over_ground  (4, 4) float   their motion after ego-motion, target sensor frame
    """

    rows: np.ndarray
    over_ground: np.ndarray


def grown(
    view: View, seed: np.ndarray, over_ground: np.ndarray, free: np.ndarray, config: ObjectsConfig
) -> Body | None:
    """The body around the rows `seed`: what hangs together with them and agrees; None if too small.

    Only rows that are `free` (N,) may be taken.

    The side of a car that moves along itself is explained by either motion, and belongs to the car when
    the car's motion explains it about as well.
    """
    is_seed, is_near = np.zeros((2, len(view.points)), bool)
    is_seed[seed] = True
    near = near_rows(view, seed, _FIRST_REACH_M)
    body = None
    for _ in range(_GROWTH_ROUNDS):
        rows = near[free[near]]
        rows = rows[_agrees(view, rows, over_ground)]
        if len(rows) < config.min_points:
            return None
        label = links.components(view.points[rows], _LINK_M)
        holds_seed = np.zeros(len(rows), bool)   # by label
        holds_seed[label[is_seed[rows]]] = True
        rows = rows[holds_seed[label]]
        if len(rows) < config.min_points:
            return None
        over_ground = fitted(view, rows, over_ground, config)
        body = Body(rows, over_ground)
        is_near[near] = True
        is_near[near_rows(view, rows, _REACH_M)] = True
        wider = np.flatnonzero(is_near)
        if len(wider) == len(near):
            break
        near = wider
    return body


def fitted(view: View, rows: np.ndarray, start: np.ndarray, config: ObjectsConfig) -> np.ndarray:
    """Motion (4, 4) of the points at `rows` onto the target's planes, from `start` (4, 4)."""
    if len(rows) > _THIN_FIT_POINTS:
        rows = rows[grid.first_per_voxel(view.points[rows], _FIT_VOXEL_M)]
    points = view.points[rows]
    return rigid_fit.onto_planes(
        points, view.source.normals[rows], view.upright, start,
        _ground_normal(view, points.mean(axis=0)), config.along_ground)


def completed(view: View, body: Body, free: np.ndarray) -> Body:
    """The body with the points it surrounds and the fragments that follow it; `free` (N,) may be taken.

    A mesh or a linkage cuts a body at its glass and its edges; what lies amid its points or moves along
    close by is a part of it.
    """
    on_body = np.zeros(len(view.points), bool)
    on_body[body.rows] = True
    near = near_rows(view, body.rows, _FRAGMENT_M)
    near = near[free[near] & ~on_body[near]]
    if len(near) == 0:
        return body
    after, by_ego = view.after(near, body.over_ground), view.by_ego.distance_m[near]
    follows = (after.distance_m <= view.tolerance_m[near])
    follows &= (after.distance_m < by_ego - _CLEARLY_BETTER_M) & view.evidence.unexplained[near]
    on_body[near[follows]] = True
    # Twice: what the first round adds surrounds others.
    for _ in range(2):
        on_body[near[_surrounded(view, on_body, near)]] = True
    return Body(np.flatnonzero(on_body), body.over_ground)


def near_rows(view: View, rows: np.ndarray, radius_m: float) -> np.ndarray:
    """Ascending rows of the view's points within `radius_m` of any of those at `rows` (K,)."""
    return neighbours.near_rows(view.source.tree, tree.build(view.points[rows]), radius_m)


def _surrounded(view: View, on_body: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Whether (K,) most neighbours of each of `rows` are on the body."""
    marks = np.column_stack([on_body, ~on_body])
    of_body, others = neighbours.counts_around(view.source.tree, marks, view.points[rows], _SURROUND_M).T
    return of_body - on_body[rows] > others - ~on_body[rows]   # the point itself has no say


def _agrees(view: View, rows: np.ndarray, over_ground: np.ndarray) -> np.ndarray:
    """Whether (K,) the motion explains the points at `rows` clearly better, or in place and about as well."""
    own = view.after(rows, over_ground)
    ego_m, ego_plane_m = view.by_ego.distance_m[rows], view.by_ego.plane_m[rows]
    fits = own.distance_m <= view.tolerance_m[rows]
    better = own.distance_m < ego_m - _CLEARLY_BETTER_M
    plane_better = fits & (own.plane_m < ego_plane_m - _AS_GOOD_M)
    as_good = fits & (own.distance_m < ego_m + _AS_GOOD_M) & (own.plane_m < ego_plane_m + _CLEARLY_BETTER_M)
    plane_worse = (own.plane_m > ego_plane_m + _AS_GOOD_M) & ~better
    return (better | plane_better | as_good) & ~plane_worse


def _ground_normal(view: View, centre: np.ndarray) -> np.ndarray:
    """Unit normal (3,) of the ground around `centre` (3,), upright where too little of it is seen."""
    up = np.array([0.0, 0.0, 1.0])
    rise_x, rise_y, count = ground_plane.slope(view.ground, centre, _SLOPE_RADIUS_M)
    if count < _MIN_SLOPE_POINTS or np.hypot(rise_x, rise_y) > _MAX_SLOPE:
        return up
    normal = np.array([-rise_x, -rise_y, 1.0])
    return normal / np.linalg.norm(normal)

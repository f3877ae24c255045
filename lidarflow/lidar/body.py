"""The points of one moving body: grown from a seed over what agrees with its motion, then completed."""

from dataclasses import dataclass

import numpy as np

from lidarflow.config import ObjectsConfig
from lidarflow.kernels import growth, neighbours, tree
from lidarflow.lidar import rigid_fit
from lidarflow.lidar.surface import CAP_M, MIN_AGREEMENT
from lidarflow.lidar.view import View

_LINK_M = 0.5            # points of one body hang together at this distance
_FIRST_REACH_M = 1.0     # a body grows by this much at first,
_REACH_M = 0.7           # then by this much at a time
_GROWTH_ROUNDS = 5
_CLEARLY_BETTER_M = 0.02
_AS_GOOD_M = 0.03
_MOST_LEFT = 0.55        # of the squared misfit of what a body has: of those that move, none leaves 0.29
_SURROUND_M = 0.35       # whose neighbours at this distance are mostly of the body belongs to it
_FRAGMENT_M = 1.0        # a fragment this near that follows the body belongs to it: glass returns nothing
# A body is thinned to fit its motion, which goes along the ground around, if enough of it is seen.
_FIT = growth.Fit(
    voxel_m=0.12, voxel_points=40, slope_radius_m=5.0, min_slope_points=20, max_slope=0.2, along_ground=0.0,
    plane_scale_m=rigid_fit.PLANE_SCALE_M, point_scale_m=rigid_fit.POINT_SCALE_M,
    point_weight=rigid_fit.POINT_WEIGHT)


@dataclass(frozen=True, slots=True, eq=False)
class Body:
    """Points that move as one.

    rows         (K,) int64     rows of the view's points
    over_ground  (4, 4) float   their motion after ego-motion, target sensor frame
    """

    rows: np.ndarray
    over_ground: np.ndarray


@dataclass(frozen=True, slots=True, eq=False)
class Growth:
    """How a body grew.

    body   Body or None   None if it was given up
    asked  (N,) bool      the rows of the view that were asked whether they belong to it
    """

    body: Body | None
    asked: np.ndarray


def grown(
    view: View, seeds: list[np.ndarray], starts: list[np.ndarray], free: np.ndarray, least_m: float,
    config: ObjectsConfig,
) -> list[Growth]:
    """The bodies around `seeds`, rows (K,) each, that move by about `starts` (4, 4), each as if alone.

    A body looks at what is near to its seeds, keeps what agrees with its motion and hangs together with a
    seed, fits the motion to that, and looks around again, until it comes near nothing new. Only rows that are
    `free` (N,) may be taken. One that its motion shifts by less than `least_m` along the ground is given up,
    and one whose shape gains too little to be accepted later: such bodies grow over whole hedges.

    The side of a car that moves along itself is explained by either motion, and belongs to the car when
    the car's motion explains it about as well: a row agrees that the motion explains clearly better, or in
    place and about as well.
    """
    if not seeds:
        return []
    own = growth.Points(
        view.points, view.source.normals, view.tolerance_m, view.by_ego.distance_m, view.by_ego.plane_m)
    limits = growth.Limits(
        _FIRST_REACH_M, _REACH_M, _GROWTH_ROUNDS, config.min_points, _LINK_M, _CLEARLY_BETTER_M, _AS_GOOD_M,
        CAP_M, MIN_AGREEMENT, least_m, max(_MOST_LEFT, config.max_shape_ratio))
    did, motions = growth.grow_each(
        *rigid_fit.concatenated(seeds), np.stack(starts), free, view.source.tree, own, view.upright.tree,
        view.upright.normals, view.ground, limits, _FIT._replace(along_ground=float(config.along_ground)),
        rigid_fit.PLANE_GATES_M)
    taken = [np.flatnonzero(own_did == growth.TAKEN) for own_did in did]
    return [Growth(Body(rows, motion) if len(rows) else None, own_did > 0)
            for rows, motion, own_did in zip(taken, motions, did, strict=True)]


def completed(view: View, growth: Growth, free: np.ndarray) -> Growth:
    """A growth whose body has the points it surrounds and the fragments that follow it, those `free` (N,).

    A mesh or a linkage cuts a body at its glass and its edges; what lies amid its points or moves along
    close by is a part of it.
    """
    body = growth.body
    if body is None:
        return growth
    on_body, asked = np.zeros(len(view.points), bool), growth.asked.copy()
    on_body[body.rows] = True
    near = near_rows(view, body.rows, _FRAGMENT_M)
    asked[near] = True
    near = near[free[near] & ~on_body[near]]
    if len(near) == 0:
        return Growth(body, asked)
    after, by_ego = view.after(near, body.over_ground), view.by_ego.distance_m[near]
    follows = (after.distance_m <= view.tolerance_m[near])
    follows &= (after.distance_m < by_ego - _CLEARLY_BETTER_M) & view.evidence.unexplained[near]
    on_body[near[follows]] = True
    # Twice: what the first round adds surrounds others.
    for _ in range(2):
        on_body[near[_surrounded(view, on_body, near)]] = True
    return Growth(Body(np.flatnonzero(on_body), body.over_ground), asked)


def near_rows(view: View, rows: np.ndarray, radius_m: float) -> np.ndarray:
    """Ascending rows of the view's points within `radius_m` of any of those at `rows` (K,)."""
    return neighbours.near_rows(view.source.tree, tree.build(view.points.take(rows, axis=0)), radius_m)


def _surrounded(view: View, on_body: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Whether (K,) most neighbours of each of `rows` are on the body."""
    body, points = tree.build(view.points.compress(on_body, axis=0)), view.points.take(rows, axis=0)
    of_body = neighbours.number_around(body, points, _SURROUND_M)
    others = neighbours.number_around(view.source.tree, points, _SURROUND_M) - of_body
    return of_body - on_body[rows] > others - ~on_body[rows]   # the point itself has no say

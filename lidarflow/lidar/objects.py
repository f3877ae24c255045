"""Moving objects: neighbouring points with one rigid motion that clearly beats ego-motion.

All points here are in the target's sensor frame after ego-motion: a static world would lie on the target as
it is, and an object's motion is what it does over ground.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from lidarflow import pose
from lidarflow.config import ObjectsConfig
from lidarflow.lidar import clusters, rigid_fit
from lidarflow.lidar.evidence import Evidence, gather, tolerance
from lidarflow.types import MovingObject

_CAP_M = 0.3             # a point farther off than this is simply not explained
_SEED_RADIUS_M = 0.5     # evidence is weighed over this neighbourhood
_SEED_SHARE = 0.35       # of what could be seen there must be unexplained
_SEED_LINK_M = 0.7
_BODY_LINK_M = 0.5       # points of one body hang together at this distance
_REACH_M = 0.7           # a body grows by this much at a time
_GROWTH_ROUNDS = 4
_VOTE_CELL_M = 0.2
_MAX_VOTERS = 150
_MAX_START_POINTS = 300  # as many choose the start; the fit that follows uses all
_MATCH_MODE_M = 0.15
_MIN_FOLLOWERS = 0.3     # share of a body's matches that must follow its motion
_CLEARLY_BETTER_M = 0.02
_AS_GOOD_M = 0.03


@dataclass(frozen=True, slots=True, eq=False)
class Body:
    """One moving object.

    rows         (K,) int64     rows among the points it was found in
    over_ground  (4, 4) float   its motion after ego-motion, target sensor frame
    """

    rows: np.ndarray
    over_ground: np.ndarray


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """The two scans as the search sees them, in the target's sensor frame.

    points         (N, 3)      non-ground source points after ego-motion
    evidence       Evidence    of the points against the whole target
    target         cKDTree     all of the target's usable points
    upright        cKDTree     those of them that are not ground
    has_appeared   (U,) bool   upright points where the source has nothing after ego-motion
    match_rows     (K,) int64  points with a descriptor match
    match_shift    (K, 3)      from such a point to its match
    """

    points: np.ndarray
    evidence: Evidence
    target: cKDTree
    upright: cKDTree
    has_appeared: np.ndarray
    match_rows: np.ndarray
    match_shift: np.ndarray


def look(
    points: np.ndarray, target_points: np.ndarray, target_ground: np.ndarray, source_points: np.ndarray,
    matched: tuple[np.ndarray, np.ndarray], config: ObjectsConfig,
) -> View:
    """The view of a pair, all in the target's sensor frame after ego-motion, metres.

    points (N, 3) the source's non-ground points; target_points (M, 3) and which of them are ground (M,);
    source_points (S, 3) all of the source; matched: rows (K,) of `points` and their matches (K, 3).
    """
    upright = target_points[~target_ground]
    from_source_m, _ = cKDTree(source_points).query(upright, workers=-1)
    has_appeared = from_source_m > tolerance(np.linalg.norm(upright, axis=1), config)
    rows, places = matched
    return View(points, gather(points, target_points, config), cKDTree(target_points), cKDTree(upright),
                has_appeared, rows, places - points[rows])


def find(view: View, dt_s: float, config: ObjectsConfig) -> list[Body]:
    """The moving objects of a view; no point belongs to two, and the best supported come first."""
    seeds = _seeds(view)
    label = clusters.linked(view.points[seeds], _SEED_LINK_M)
    bodies, taken = [], np.zeros(len(view.points), bool)
    for cluster in np.argsort(-np.bincount(label), kind="stable") if len(label) else ():
        seed = seeds[label == cluster]
        seed = seed[~taken[seed]]
        if len(seed) < config.min_points:
            continue
        body = _grown(view, seed, _best_start(view, seed), config)
        if body is None or not _moves(view, body, dt_s, config):
            continue
        rows = body.rows[~taken[body.rows]]
        if len(rows) >= config.min_points:
            bodies.append(Body(rows, body.over_ground))
            taken[rows] = True
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


def _seeds(view: View) -> np.ndarray:
    """Rows of the unexplained points in whose neighbourhood a good share is unexplained."""
    unexplained = np.flatnonzero(view.evidence.unexplained)
    if len(unexplained) == 0:
        return unexplained
    observable = np.flatnonzero(~view.evidence.blind)
    points = view.points[unexplained]
    among_unexplained = cKDTree(points).query_ball_point(points, _SEED_RADIUS_M, return_length=True)
    among_all = cKDTree(view.points[observable]).query_ball_point(points, _SEED_RADIUS_M, return_length=True)
    return unexplained[(among_unexplained >= 4) & (among_unexplained >= _SEED_SHARE * among_all)]


def _best_start(view: View, seed: np.ndarray) -> np.ndarray:
    """Motion (4, 4) of the seed points with the smallest misfit among matches' and votes' translations."""
    points = _spread(view.points[seed], _MAX_START_POINTS)
    fits = [rigid_fit.onto(points, view.upright, shift)
            for shift in [*_match_translations(view, points), *_voted_translations(view, points)]]
    fits = fits or [np.eye(4)]
    return min(fits, key=lambda fit: _misfit_sq(view, points, fit))


def _misfit_sq(view: View, points: np.ndarray, over_ground: np.ndarray) -> float:
    return float((_left(view.upright, pose.apply(over_ground, points)) ** 2).mean())


def _left(tree: cKDTree, points: np.ndarray) -> np.ndarray:
    """Distance (N,) of points (N, 3) to the nearest point of `tree`, at most _CAP_M."""
    return np.minimum(tree.query(points, distance_upper_bound=_CAP_M)[0], _CAP_M)


def _match_translations(view: View, points: np.ndarray) -> list[np.ndarray]:
    """The most common shift of the matches on these points, and their median."""
    near, _ = cKDTree(points).query(view.points[view.match_rows], distance_upper_bound=_SEED_RADIUS_M)
    shifts = view.match_shift[np.isfinite(near)]
    if len(shifts) < 3:
        return []
    tree = cKDTree(shifts)
    friends = tree.query_ball_point(shifts, _MATCH_MODE_M)
    mode = max(friends, key=len)
    return [shifts[mode].mean(axis=0), np.median(shifts, axis=0)]


def _voted_translations(view: View, points: np.ndarray, max_shift_m: float = 3.0) -> list[np.ndarray]:
    """The three translations that most often lead from these points to what appeared near them."""
    appeared = view.upright.data[view.has_appeared]
    if len(appeared) == 0:
        return []
    distance_m, _ = cKDTree(points).query(appeared, distance_upper_bound=max_shift_m)
    near = _spread(appeared[np.isfinite(distance_m)], 2 * _MAX_VOTERS)
    if len(near) < 4:
        return []
    shifts = (near[None] - _spread(points, _MAX_VOTERS)[:, None]).reshape(-1, 3)
    along_ground = np.hypot(shifts[:, 0], shifts[:, 1]) <= max_shift_m
    shifts = shifts[along_ground & (np.abs(shifts[:, 2]) <= _CAP_M)]
    if len(shifts) == 0:
        return []
    cells = np.floor(shifts[:, :2] / _VOTE_CELL_M).astype(np.int64)
    _, member, votes = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    return [shifts[member.ravel() == cell].mean(axis=0) for cell in np.argsort(-votes, kind="stable")[:3]]


def _spread(points: np.ndarray, count: int) -> np.ndarray:
    """At most `count` of the points (N, 3), evenly over their order."""
    if len(points) <= count:
        return points
    return points[np.linspace(0, len(points) - 1, count).astype(int)]


def _grown(
    view: View, seed: np.ndarray, over_ground: np.ndarray, config: ObjectsConfig
) -> Body | None:
    """The body around a seed: what hangs together with it and agrees with its motion; None if too small.

    The side of a car that moves along itself is explained by either motion, and belongs to the car when
    the car's motion explains it about as well.
    """
    range_m = np.linalg.norm(view.points, axis=1)
    near = _around(view.points, view.points[seed], 1.0)
    body = None
    for _ in range(_GROWTH_ROUNDS):
        by_own = _left(view.target, pose.apply(over_ground, view.points[near]))
        by_ego = np.minimum(view.evidence.left_m[near], _CAP_M)
        fits = by_own <= tolerance(range_m[near], config)
        agrees = (by_own < by_ego - _CLEARLY_BETTER_M) | (fits & (by_own < by_ego + _AS_GOOD_M))
        rows = near[agrees]
        if len(rows) < config.min_points:
            return None
        label = clusters.linked(view.points[rows], _BODY_LINK_M)
        rows = rows[np.isin(label, label[np.isin(rows, seed)])]
        if len(rows) < config.min_points:
            return None
        shift = (pose.apply(over_ground, view.points[rows]) - view.points[rows]).mean(axis=0)
        over_ground = rigid_fit.onto(view.points[rows], view.upright, shift)
        body = Body(rows, over_ground)
        wider = np.union1d(near, _around(view.points, view.points[rows], _REACH_M))
        if len(wider) == len(near):
            break
        near = wider
    return body


def _around(points: np.ndarray, body: np.ndarray, radius_m: float) -> np.ndarray:
    """Sorted rows of points (N, 3) within `radius_m` of any of the points of `body` (K, 3)."""
    low, high = body.min(axis=0) - radius_m, body.max(axis=0) + radius_m
    rows = np.flatnonzero(((points >= low) & (points <= high)).all(axis=1))
    distance_m, _ = cKDTree(body).query(points[rows], distance_upper_bound=radius_m, workers=-1)
    return rows[np.isfinite(distance_m)]


def _moves(view: View, body: Body, dt_s: float, config: ObjectsConfig) -> bool:
    """Whether the body is fast enough, and geometry and descriptors together prefer its own motion.

    Geometry alone is deceived by leaves that flicker and by parked cars seen anew, descriptors alone by
    what looks alike; the two are deceived by different things, so their ratios of misfit multiply.
    """
    points = view.points[body.rows]
    moved = pose.apply(body.over_ground, points)
    shift = (moved - points).mean(axis=0)
    if np.hypot(shift[0], shift[1]) < config.min_speed_m_per_s * dt_s:
        return False
    left = view.evidence.unexplained[body.rows].mean()
    if min(left, _arrived(view, moved)) < config.min_unexplained:
        return False
    by_shape, by_matches = _shape_ratio(view, body), _match_ratio(view, body, config)
    return max(by_shape, by_matches) < 1.0 and by_shape * by_matches <= config.max_misfit_ratio


def _arrived(view: View, moved: np.ndarray) -> float:
    """Share of the moved points (K, 3) that end where the source, as it stood, had nothing.

    What a newcomer hides seems to have left, but has arrived nowhere new.
    """
    off_m, nearest = view.upright.query(moved, distance_upper_bound=_CAP_M)
    found = np.isfinite(off_m)
    return float(view.has_appeared[nearest[found]].mean()) if found.any() else 0.0


def _shape_ratio(view: View, body: Body) -> float:
    """Mean squared distance to the next scan after the body's own motion, over that after ego-motion."""
    seen = body.rows[~view.evidence.blind[body.rows]]
    by_ego = np.minimum(view.evidence.left_m[seen], _CAP_M)
    by_own = _left(view.target, pose.apply(body.over_ground, view.points[seen]))
    return _ratio(by_own, by_ego)


def _match_ratio(view: View, body: Body, config: ObjectsConfig) -> float:
    """The same for descriptor matches on the body; infinite where too few of them follow it."""
    on_body = np.isin(view.match_rows, body.rows)
    points, shift = view.points[view.match_rows[on_body]], view.match_shift[on_body]
    off_own_m = np.linalg.norm(points + shift - pose.apply(body.over_ground, points), axis=1)
    follow = (off_own_m < _CAP_M).sum()
    if follow < config.min_matches or follow < _MIN_FOLLOWERS * len(points):
        return np.inf
    return _ratio(np.minimum(off_own_m, _CAP_M), np.minimum(np.linalg.norm(shift, axis=1), _CAP_M))


def _ratio(own_m: np.ndarray, ego_m: np.ndarray) -> float:
    ego_sq = float((ego_m**2).sum())
    return float((own_m**2).sum()) / ego_sq if ego_sq > 0 else np.inf

"""Does a body move, or does something merely look so?"""

import numpy as np

from lidarflow import pose
from lidarflow.config import ObjectsConfig
from lidarflow.kernels import ground_plane, neighbours, tree, votes
from lidarflow.lidar.body import Body, near_rows
from lidarflow.lidar.evidence import tolerance
from lidarflow.lidar.hypotheses import NONE, Expected, shifts_expected
from lidarflow.lidar.surface import CAP_M, misfit_after
from lidarflow.lidar.view import View
from lidarflow.rows import lengths, mean, median

_GROUND_RADIUS_M = 10.0
_MIN_GROUND_POINTS = 20
_OWN_M = 0.7             # what is nearer to a body may be a part of it
_SURROUNDINGS_M = 3.0
_MIN_SURROUNDINGS = 100
_CLEARLY_OFF = 1.5       # tolerances; at one, every other point is still explained by chance
_GAIN_M = 0.01           # less is noise
_AS_EXPECTED = 0.25      # share of its motion by which an object that goes on as before may be off
_AROUND_M = 0.25   # target points this near to a moved body should be the body's


def moves(
    view: View, body: Body, dt_s: float, config: ObjectsConfig, expected: Expected = NONE
) -> bool:
    """Whether a body is fast enough, and its shape, its matches and the space it took all say that it moves.

    Each is deceived by something else: distances by leaves that flicker and by places seen anew, planes by
    walls along which any motion fits, matches by what looks alike.
    """
    return seems_to_move(view, body, dt_s, config, expected) and matches_agree(view, body, config)


def seems_to_move(
    view: View, body: Body, dt_s: float, config: ObjectsConfig, expected: Expected = NONE
) -> bool:
    """Whether all but the matches, which cost most, says that a body moves."""
    points, moved, shift = _shifted(view, body)
    if np.hypot(shift[0], shift[1]) < config.min_speed_m_per_s * dt_s:
        return False
    # What costs most comes last.
    return (
        (_observability(view, body, shift) >= config.min_observability
         or _goes_on(view, body, moved, shift, expected, config))
        and min(_left_and_arrived(view, body, moved)) >= config.min_unexplained * _should_show(
            view, body, moved, shift, config)
        and _clearance(view, points) <= config.max_clearance_m
        and _shape_ratio(view, body, moved) <= config.max_shape_ratio
        and not _surroundings_gain(view, body, shift))


def matches_agree(view: View, body: Body, config: ObjectsConfig) -> bool:
    """Whether the body's median descriptor match is near to where its motion leads, along the ground.

    It may be off by config.max_match_deviation of the motion, and by CAP_M at most.
    """
    rows, places = view.matches(body.rows)
    if len(rows) < max(config.min_matches, 1):
        return config.min_matches == 0
    _, _, shift = _shifted(view, body)
    off = votes.median(places - pose.apply(body.over_ground, view.points[rows]))
    return np.hypot(off[0], off[1]) <= min(config.max_match_deviation * np.hypot(shift[0], shift[1]), CAP_M)


def _shifted(view: View, body: Body) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The body's points (K, 3), where they go (K, 3), and their mean shift (3,)."""
    points = view.points.take(body.rows, axis=0)
    moved = pose.apply(body.over_ground, points)
    return points, moved, mean(moved - points)


def _clearance(view: View, points: np.ndarray) -> float:
    """Height in metres of the lowest point over the ground around it; 0 where no ground is seen."""
    lowest = points[np.argmin(points[:, 2])]
    heights = ground_plane.heights(view.ground, lowest[0], lowest[1], _GROUND_RADIUS_M)
    if len(heights) < _MIN_GROUND_POINTS:
        return 0.0
    return float(lowest[2] - median(heights))


def _shape_ratio(view: View, body: Body, moved: np.ndarray) -> float:
    """Mean squared plane distance after the body's own motion over that after ego-motion, in both scans.

    Of the source count the body's points where the sensor looked again, of the target those around where the
    body went, brought back: what fits a few of many points by chance does not fit the other way.
    """
    seen = body.rows[~view.evidence.blind[body.rows]]
    own_sq = (view.after(seen, body.over_ground).plane_m**2).sum()
    ego_sq = (view.by_ego.plane_m[seen] ** 2).sum()

    around = neighbours.near_rows(view.upright.tree, tree.build(moved), _AROUND_M)
    back = pose.inverse(body.over_ground)
    own_sq += (misfit_after(view.upright, around, back, view.source).plane_m ** 2).sum()
    ego_sq += (misfit_after(view.upright, around, np.eye(4), view.source).plane_m ** 2).sum()
    return float(own_sq / ego_sq) if ego_sq > 0 else np.inf


def _surroundings_gain(view: View, body: Body, shift: np.ndarray) -> bool:
    """Whether the same motion explains more of what surrounds the body too: then the ego-motion is off."""
    if np.linalg.norm(shift) > CAP_M:
        return False   # no ego-motion is that far off
    around = np.setdiff1d(
        near_rows(view, body.rows, _SURROUNDINGS_M), near_rows(view, body.rows, _OWN_M), assume_unique=True)
    if len(around) < _MIN_SURROUNDINGS:
        return False
    gain_m = view.by_ego.plane_m[around] - view.after(around, body.over_ground).plane_m
    return int((gain_m > _GAIN_M).sum()) > int((gain_m < -_GAIN_M).sum())


def _observability(view: View, body: Body, shift: np.ndarray) -> float:
    """Mean squared cosine between the body's normals and the way it moves, `shift` (3,).

    A wall explains any motion along itself, so that none is to be believed (the aperture problem).
    """
    cosines = view.source.normals.take(body.rows, axis=0) @ (shift / np.linalg.norm(shift))
    cosines = cosines[np.isfinite(cosines)]
    return float((cosines**2).mean()) if len(cosines) else 0.0


def _goes_on(
    view: View, body: Body, moved: np.ndarray, shift: np.ndarray, expected: Expected,
    config: ObjectsConfig,
) -> bool:
    """Whether a body does what an object that was there should do, and clearly left and arrived.

    Of a car that passes beside the sensor little but its side is seen. Its motion is known from before, when
    its front was; that something moves at all, which no wall tells, from the places that it left and took.
    """
    if min(_left_and_arrived(view, body, moved)) < config.min_unexplained:
        return False
    known = shifts_expected(tree.build(view.points.take(body.rows, axis=0)), expected)
    return any(np.linalg.norm(shift - one) <= _AS_EXPECTED * np.linalg.norm(one) for one in known)


def _left_and_arrived(view: View, body: Body, moved: np.ndarray) -> tuple[float, float]:
    """Share of the body that left where it was, and share that arrived where the source had nothing.

    What a newcomer hides seems to have left, but has arrived nowhere new.
    """
    left = float(view.evidence.unexplained[body.rows].mean())
    _, row = neighbours.query(view.upright.tree, moved, CAP_M)
    row = row[row >= 0]
    return left, float(view.has_appeared[row].mean()) if len(row) else 0.0


def _should_show(
    view: View, body: Body, moved: np.ndarray, shift: np.ndarray, config: ObjectsConfig
) -> float:
    """Share of the body whose surface the motion shifts by clearly more than explained points may be off."""
    # Where there is no normal, no shift of the surface is told: NaN is not more than anything.
    away_m = np.abs(view.source.normals.take(body.rows, axis=0) @ shift)
    return float((away_m > _CLEARLY_OFF * tolerance(lengths(moved), config)).mean())

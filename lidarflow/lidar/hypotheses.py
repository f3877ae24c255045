"""What a cluster of seeds may have done: translations that matches, votes and planes propose."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from lidarflow.lidar.clusters import near_rows
from lidarflow.lidar.surface import CAP_M
from lidarflow.lidar.view import View

_MATCH_RADIUS_M = 0.5    # matches this near to the seeds speak for them
_MATCH_MODE_M = 0.15
_MIN_MATCHES = 3
_EXPECTED_RADIUS_M = 0.5
_VOTE_CELL_M = 0.2
_VOTE_PEAKS = 3
_MAX_VOTERS = 150
_MIN_APPEARED = 4
_MIN_SHIFTED = 5


@dataclass(frozen=True, slots=True, eq=False)
class Expected:
    """An object that earlier pairs lead to expect.

    points  (K, 3)   where it should be before it moves, metres, in the frame of the view
    shift   (3,)     what it should do over ground, metres
    """

    points: np.ndarray
    shift: np.ndarray


def translations(
    view: View, rows: np.ndarray, shift: np.ndarray, expected: tuple[Expected, ...], max_shift_m: float
) -> list[np.ndarray]:
    """Translations over ground (3,), metres, of the seeds at `rows` (K,), whose planes tell shifts (K, 3)."""
    points = view.points[rows]
    return [*_of_matches(view, points), *_of_planes(shift), *_of_expected(points, expected),
            *_of_votes(view, points, max_shift_m)]


def spread(points: np.ndarray, count: int) -> np.ndarray:
    """At most `count` of the points (N, …), evenly over their order."""
    if len(points) <= count:
        return points
    return points[np.linspace(0, len(points) - 1, count).astype(int)]


def _of_matches(view: View, points: np.ndarray) -> list[np.ndarray]:
    """The most common shift of the matches on these points, and their median."""
    near, _ = cKDTree(points).query(view.points[view.match_rows], distance_upper_bound=_MATCH_RADIUS_M)
    shifts = view.match_shift[np.isfinite(near)]
    if len(shifts) < _MIN_MATCHES:
        return []
    friends = cKDTree(shifts).query_ball_point(shifts, _MATCH_MODE_M)
    mode = max(friends, key=len)
    return [shifts[mode].mean(axis=0), np.median(shifts, axis=0)]


def _of_planes(shift: np.ndarray) -> list[np.ndarray]:
    """The median of the shifts that planes tell."""
    known = shift[np.isfinite(shift[:, 0])]
    return [np.median(known, axis=0)] if len(known) >= _MIN_SHIFTED else []


def _of_expected(points: np.ndarray, expected: tuple[Expected, ...]) -> list[np.ndarray]:
    """The shifts of the expected objects that these points may be on."""
    return [e.shift for e in expected if len(near_rows(e.points, points, _EXPECTED_RADIUS_M))]


def _of_votes(view: View, points: np.ndarray, max_shift_m: float) -> list[np.ndarray]:
    """The translations that most often lead from these points to what appeared near them."""
    appeared = view.upright.points[view.has_appeared]
    if len(appeared) == 0:
        return []
    distance_m, _ = cKDTree(points).query(appeared, distance_upper_bound=max_shift_m)
    near = spread(appeared[np.isfinite(distance_m)], 2 * _MAX_VOTERS)
    if len(near) < _MIN_APPEARED:
        return []
    shifts = (near[None] - spread(points, _MAX_VOTERS)[:, None]).reshape(-1, 3)
    along_ground = np.hypot(shifts[:, 0], shifts[:, 1]) <= max_shift_m
    shifts = shifts[along_ground & (np.abs(shifts[:, 2]) <= CAP_M)]
    if len(shifts) == 0:
        return []
    cells = np.floor(shifts[:, :2] / _VOTE_CELL_M).astype(np.int64)
    _, member, votes = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    peaks = np.argsort(-votes, kind="stable")[:_VOTE_PEAKS]
    return [shifts[member.ravel() == cell].mean(axis=0) for cell in peaks]

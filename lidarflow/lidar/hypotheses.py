"""What a cluster of seeds may have done: translations that votes, planes and tracks propose."""

from dataclasses import dataclass

import numpy as np

from lidarflow.kernels import neighbours, tree, votes
from lidarflow.kernels.tree import Tree
from lidarflow.lidar.surface import CAP_M
from lidarflow.lidar.view import View
from lidarflow.rows import spread

_EXPECTED_RADIUS_M = 0.5   # seeds this near to where an object should be may be on it
_VOTE_CELL_M = 0.2         # translations within one cell are one
_VOTE_PEAKS = 3            # translations with most votes that are proposed
_MAX_VOTERS = 150          # seeds that vote, each for every newcomer near by; of those, twice as many
_MIN_APPEARED = 4          # fewer newcomers are no surface that has moved there
_MIN_SHIFTED = 5           # and fewer planes tell no shift


@dataclass(frozen=True, slots=True, eq=False)
class Expected:
    """The objects that earlier pairs lead to expect.

    points  Tree        over all their points (K, 3), where they should be before they move, frame of the view
    number  (K,) int64  of the object that each point is on
    shifts  (E, 3)      what the objects should do over ground, metres
    """

    points: Tree
    number: np.ndarray
    shifts: np.ndarray


NONE = Expected(tree.NOTHING, np.empty(0, np.int64), np.empty((0, 3)))


def translations(
    view: View, rows: np.ndarray, shift: np.ndarray, expected: Expected, max_shift_m: float
) -> list[np.ndarray]:
    """Translations over ground (3,), metres, of the seeds at `rows` (K,), whose planes tell shifts (K, 3)."""
    points = view.points[rows]
    body = tree.build(points)
    return [*_of_planes(shift), *shifts_expected(body, expected),
            *_of_votes(view, points, body, max_shift_m)]


def _of_planes(shift: np.ndarray) -> list[np.ndarray]:
    """The median of the shifts that planes tell."""
    known = shift[np.isfinite(shift[:, 0])]
    return [votes.median(known)] if len(known) >= _MIN_SHIFTED else []


def shifts_expected(body: Tree, expected: Expected) -> list[np.ndarray]:
    """The shifts over ground (3,), metres, of the expected objects that a tree's points may be on."""
    near = neighbours.near_rows(expected.points, body, _EXPECTED_RADIUS_M)
    return list(expected.shifts[np.unique(expected.number[near])])


def _of_votes(view: View, points: np.ndarray, body: Tree, max_shift_m: float) -> list[np.ndarray]:
    """The translations that most often lead from these points to what appeared near them."""
    near = neighbours.near_rows(view.appeared, body, max_shift_m)
    if len(near) < _MIN_APPEARED:
        return []
    appeared = view.newcomers[spread(near, 2 * _MAX_VOTERS)]
    return list(votes.peaks(
        spread(points, _MAX_VOTERS), appeared, max_shift_m, CAP_M, _VOTE_CELL_M, _VOTE_PEAKS))

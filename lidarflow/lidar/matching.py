"""Correspondences between keypoints of two scans, by SHOT descriptors inside a gate."""

from collections.abc import Callable
from functools import cached_property

import numpy as np

from lidarflow.config import MatchingConfig
from lidarflow.kernels import matching as kernel
from lidarflow.kernels import neighbours, tree
from lidarflow.kernels.matching import Described
from lidarflow.kernels.tree import Tree
from lidarflow.lidar.keypoints import Keypoints
from lidarflow.rows import lengths

_UNKNOWN, _NONE = -2, -1
_ROUNDING = 1e-9


def match(
    queries: Described, candidates: Described, rivals: Callable[[np.ndarray], Described], gate_m: float,
    config: MatchingConfig,
) -> tuple[np.ndarray, np.ndarray]:
    """Which queries (K,) and which candidates (K,) are each other's match.

    Queries are where their start values put them, in the frame of the candidates. A match lies inside the
    gate, and survives when its rival elsewhere in the gate is clearly worse (ratio test) and matching back
    from it ends near the query (mutual best, within the keypoints' spacing). `rivals` gives what matching
    back from some places (M, 3) may end at.
    """
    best, best_sq, rival_sq = kernel.best_in_gate(queries, candidates, gate_m, config.rival_radius_m)
    query = np.flatnonzero((best >= 0) & (best_sq <= config.max_ratio**2 * rival_sq))
    found, of_query = np.unique(best[query], return_inverse=True)
    matched = candidates.part(found)
    ends = rivals(matched.points)
    back, _, _ = kernel.best_in_gate(matched, ends, gate_m, config.rival_radius_m)
    returned = np.append(ends.points, np.full((1, 3), np.inf), axis=0)[back[of_query]]
    mutual = lengths(returned - queries.points[query]) <= config.mutual_radius_m
    return query[mutual], best[query[mutual]]


class Matches:
    """Matches of a scan's keypoints in the next scan, each looked for when it is first asked for.

    They are those among all keypoints that are eligible: whatever else is asked for changes none.
    """

    def __init__(
        self, source: Keypoints, eligible: np.ndarray, predicted: np.ndarray, target: Keypoints, dt_s: float,
        config: MatchingConfig,
    ):
        """The `eligible` (E,) of the source's keypoints, ascending, with all of the target's.

        predicted (E, 3) is where start values put them, in the frame of the target.
        """
        self._source, self._eligible, self._target = source, eligible, target
        self._row = source.row[eligible]
        self._predicted, self._config = predicted, config
        self._gate_m = config.max_speed_m_per_s * dt_s
        self._found = np.full(len(eligible), _UNKNOWN)

    @cached_property
    def _predicted_tree(self) -> Tree:
        return tree.build(self._predicted)

    def of(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Those of `rows` (R,) of the source scan that have a match, ascending (M,), and its place (M, 3)."""
        place = np.searchsorted(self._row, rows)
        is_asked = np.zeros(len(self._row), bool)
        is_asked[place[np.append(self._row, -1)[place] == rows]] = True
        asked = np.flatnonzero(is_asked)
        new = asked[self._found[asked] == _UNKNOWN]
        if len(new):
            self._look_for(new)
        asked = asked[self._found[asked] >= 0]
        return self._row[asked], self._target.points[self._found[asked]]

    def _look_for(self, asked: np.ndarray) -> None:
        """Find the matches of some (A,) of the eligible keypoints."""
        queries = self._described(asked)
        targets = self._target.described(self._within_gates(self._target.tree, queries.points))
        query, found = match(queries, targets, self._around, self._gate_m, self._config)
        self._found[asked] = _NONE
        self._found[np.searchsorted(self._eligible, queries.row[query])] = targets.row[found]

    def _around(self, places: np.ndarray) -> Described:
        return self._described(self._within_gates(self._predicted_tree, places))

    def _described(self, chosen: np.ndarray) -> Described:
        """Those of the eligible keypoints (C,) that have a descriptor, where they are predicted."""
        found = self._source.described(self._eligible[chosen])
        return found._replace(points=self._predicted[np.searchsorted(self._eligible, found.row)])

    def _within_gates(self, among: Tree, points: np.ndarray) -> np.ndarray:
        return neighbours.near_rows(among, tree.build(points), (1.0 + _ROUNDING) * self._gate_m)

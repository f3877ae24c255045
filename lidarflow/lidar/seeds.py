"""Where something may have moved: points that ego-motion leaves behind, or shifts all one way."""

from dataclasses import dataclass

import numpy as np

from lidarflow.config import ObjectsConfig
from lidarflow.kernels import coherence, links, neighbours
from lidarflow.kernels.tree import Tree
from lidarflow.lidar.view import View
from lidarflow.rows import lengths

MIN_SEEDS = 5            # a cluster with fewer is none
_LINK_M = 0.7
_NEIGHBOURHOOD_M = 0.5   # evidence is weighed over this neighbourhood
_LEFT_SHARE = 0.35       # of what could be seen there must be unexplained
_LEFT_POINTS = 4
_MIN_PLANES = 8          # so many plane distances tell a shift
_MIN_COHERENCE = 0.5     # share of their squares that one shift explains
_EXPECTED_RADIUS_M = 0.2
_MIN_RMS_M = 0.035       # smaller distances are range noise


@dataclass(frozen=True, slots=True, eq=False)
class Seeds:
    """Points to look for objects at.

    rows      (K,) int64   ascending rows of the view's points
    shift     (K, 3)       the local shift over ground that planes tell, metres; NaN where they tell none
    clusters  tuple        of positions (C,) in these: what hangs together and has enough, the largest first
    """

    rows: np.ndarray
    shift: np.ndarray
    clusters: tuple[np.ndarray, ...]


def find(view: View, expected: Tree, config: ObjectsConfig) -> Seeds:
    """Unexplained points amid unexplained ones, and points whose surface is shifted as one.

    The first finds what moves by more than the spacing of points, the second what moves by less: on leaves,
    plane distances point all ways and no shift explains them. Where objects are `expected`, given as a tree
    of their points, everything is a seed.
    """
    shifted, shift = _shifted(view, config)
    is_seed = np.zeros(len(view.points), bool)
    is_seed[shifted] = is_seed[_left_behind(view)] = True
    is_seed[neighbours.near_rows(view.source.tree, expected, _EXPECTED_RADIUS_M)] = True
    rows = np.flatnonzero(is_seed)
    shift_of = np.full((len(rows), 3), np.nan)
    shift_of[np.searchsorted(rows, shifted)] = shift
    return Seeds(rows, shift_of, _clusters(view.points.take(rows, axis=0)))


def _clusters(points: np.ndarray) -> tuple[np.ndarray, ...]:
    label = links.components(points, _LINK_M)
    counts = np.bincount(label)
    members = np.split(np.argsort(label, kind="stable"), np.cumsum(counts)[:-1])
    largest_first = np.argsort(-counts, kind="stable")
    return tuple(members[cluster] for cluster in largest_first if counts[cluster] >= MIN_SEEDS)


def _left_behind(view: View) -> np.ndarray:
    """Rows of the unexplained points in whose neighbourhood a good share is unexplained."""
    unexplained = np.flatnonzero(view.evidence.unexplained)
    if len(unexplained) == 0:
        return unexplained
    marks = np.column_stack([view.evidence.unexplained, ~view.evidence.blind])
    around = neighbours.counts_around(
        view.source.tree, marks, view.points.take(unexplained, axis=0), _NEIGHBOURHOOD_M)
    among_unexplained, among_all = around.T
    return unexplained[(among_unexplained >= _LEFT_POINTS) & (among_unexplained >= _LEFT_SHARE * among_all)]


def _shifted(view: View, config: ObjectsConfig) -> tuple[np.ndarray, np.ndarray]:
    """Rows (K,) of thinned points whose neighbourhood is shifted by config.min_shift_m or more, and how."""
    rows = view.source.thinned
    agrees = view.at_rest.within(_NEIGHBOURHOOD_M)[rows]
    planes, offsets_m = np.full((len(rows), 3), np.nan), np.full(len(rows), np.nan)
    planes[agrees] = view.upright.normals.take(view.at_rest.row[rows[agrees]], axis=0)
    offsets_m[agrees] = view.at_rest.offset_m[rows[agrees]]
    shift, count, before_m, after_m = coherence.local_shifts(
        view.points.take(rows, axis=0), planes, offsets_m, _NEIGHBOURHOOD_M, _MIN_PLANES, _MIN_RMS_M)
    explained = after_m**2 <= (1.0 - _MIN_COHERENCE) * before_m**2
    shifted = (count >= _MIN_PLANES) & (before_m >= _MIN_RMS_M) & explained
    shifted &= lengths(shift) >= config.min_shift_m
    return rows[shifted], shift[shifted]

"""How well a motion is known: from the planes that hold it, and how far they are off."""

import numpy as np
from scipy.spatial import cKDTree

from lidarflow import pose
from lidarflow.kernels import deviation, grid, neighbours
from lidarflow.lidar.body import Body
from lidarflow.lidar.surface import CAP_M, Counterparts, counterparts
from lidarflow.lidar.view import View
from lidarflow.rows import lengths, mean, median
from lidarflow.types import FlowProblem

_CELL_M = 0.5            # planes within one cell err together and count as one
_GROUND_CELL_M = 2.0
_PRIOR_STD_M = 1.0       # of a shift, where no plane tells anything
_PRIOR_STD_RAD = 0.1
_LEAST_STD_M = 0.01      # of one plane: calibration and range noise do not average out below it
_NEAREST_MATCHES = 8
_MATCH_REACH_M = 1.4     # descriptors within one another's support err together,
_MATCH_SPACING_M = 0.7   # the less, the farther apart they are
_APART_M = 1e6
_CALIBRATION_M = 0.005   # of a sensor's ranges and angles: what planes cannot show
_CALIBRATION_RAD = 2e-4
_TRIMMED = 3.0           # planes farther off than this many median distances are outliers


def of_world(view: View, still: np.ndarray, moved: np.ndarray) -> np.ndarray:
    """Standard deviation (N,) in metres of points `moved` (N, 3) by ego-motion, target frame.

    It rests on the planes of the view's rows `still` (K,) and on the ground.
    """
    thinned = np.zeros(len(view.points), bool)
    thinned[view.source.thinned] = True
    rows = still[thinned[still]]
    at, normals, off_m = _planes(view, view.points.take(rows, axis=0), view.at_rest[rows])
    ground_at, ground_off_m = _ground(view)
    at, off_m = np.concatenate([at, ground_at]), np.concatenate([off_m, ground_off_m])
    normals = np.concatenate([normals, np.tile([0.0, 0.0, 1.0], (len(ground_at), 1))])
    return _std(moved, at, normals, off_m, np.zeros((0, 3)))


def of_body(view: View, body: Body, moved: np.ndarray, along_ground: float) -> np.ndarray:
    """Standard deviation (K,) in metres of points `moved` (K, 3) with a body, target frame."""
    there = pose.apply(body.over_ground, view.points.take(body.rows, axis=0))
    turned = pose.turn(body.over_ground, view.source.normals.take(body.rows, axis=0))
    at, normals, off_m = _planes(view, there, counterparts(there, turned, view.upright, CAP_M))
    upright = np.tile([[0.0, 0.0, 1.0]], (1 if along_ground > 0 else 0, 1))
    return _std(moved, at, normals, off_m, upright)


def _planes(
    view: View, points: np.ndarray, found: Counterparts
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The points (K, 3) that meet a plane, of those given, its normals (K, 3), and how far off it is (K,)."""
    met = found.within(CAP_M)
    return (points.compress(met, axis=0), view.upright.normals.take(found.row[met], axis=0),
            found.offset_m[met])


def _ground(view: View) -> tuple[np.ndarray, np.ndarray]:
    """Ground points (K, 3) of the target, one per cell, and how far over the source's they lie (K,)."""
    ground = view.ground.points
    ground = ground.take(grid.first_per_voxel(ground, _GROUND_CELL_M), axis=0)
    _, row = neighbours.query(view.source_ground, ground, _CELL_M)
    ground, row = ground[row >= 0], row[row >= 0]
    height_m = np.empty(len(view.source_ground.rows))
    height_m[view.source_ground.rows] = view.source_ground.points[:, 2]
    return ground, height_m[row] - ground[:, 2]


def _std(
    moved: np.ndarray, at: np.ndarray, normals: np.ndarray, off_m: np.ndarray, held: np.ndarray
) -> np.ndarray:
    """Standard deviation (N,) of points that move with a fit to planes.

    Its covariance is (Σ JᵀJ / (n s²) + prior)⁻¹, where J is the row [x × n, n] of a plane at x, s its
    standard deviation over the fit, n the planes in its cell. Directions `held` (H, 3) count as known.
    """
    centre = mean(at) if len(at) else np.zeros(3)
    information = np.diag([_PRIOR_STD_RAD**-2] * 3 + [_PRIOR_STD_M**-2] * 3)
    if len(at):
        size = np.abs(off_m)
        kept = size <= _TRIMMED * max(median(size), _LEAST_STD_M)
        at, normals, off_m = at.compress(kept, axis=0), normals.compress(kept, axis=0), off_m[kept]
        variance = max(float((off_m**2).mean()), _LEAST_STD_M**2)
        cell, count = grid.voxels(at - centre, _CELL_M)
        information += deviation.information(at, normals, centre, 1.0 / (count[cell] * variance))
    for direction in held:
        row = np.concatenate([np.zeros(3), direction])
        information += np.outer(row, row) / _LEAST_STD_M**2
    return deviation.of_twist(
        np.linalg.inv(information), np.ascontiguousarray(moved), centre, _CALIBRATION_M, _CALIBRATION_RAD)


def of_matches(problem: FlowProblem, motions: np.ndarray, truncation_m: float) -> np.ndarray:
    """Standard deviation (M,) in metres of solved variables, from the matches around each of them.

    It is how far the nearest inliers of the component are off, over the root of how many independent ones
    there are: those within reach, times the square of spacing over reach, at least 1. NaN without an inlier.
    """
    at, target = problem.points[problem.match_index], problem.match_target
    off_m = lengths(pose.apply(motions[problem.match_index], at) - target)
    kept = off_m <= truncation_m
    component = problem.component[problem.match_index[kept]]
    # Components far apart along a fourth axis share one tree.
    tree = cKDTree(np.column_stack([at[kept], component * _APART_M]))
    query = np.column_stack([problem.points, problem.component * _APART_M])
    distance_m, row = tree.query(query, k=_NEAREST_MATCHES, distance_upper_bound=_APART_M / 2)
    found = np.isfinite(distance_m)
    off_sq = np.where(found, np.append(off_m[kept] ** 2, 0.0)[row], 0.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean_sq = off_sq.sum(axis=1) / found.sum(axis=1)
    near = tree.query_ball_point(query, _MATCH_REACH_M, return_length=True)
    return np.sqrt(mean_sq / np.maximum(near * (_MATCH_SPACING_M / _MATCH_REACH_M) ** 2, 1.0))

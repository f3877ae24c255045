"""Ground points by Patchwork++ (Lee, Lim, Myung 2022), for sensors at any height."""

import contextlib
import os
import sys

import numpy as np

from lidarflow.config import GroundConfig
from lidarflow.kernels import ground_level

_PATCHWORK_HEIGHT_M = 1.723   # the height Patchwork++ is tuned for; clouds are shifted to it
_CELL_M = 2.0
_NEAR_M = 20.0
_MIN_CELL_POINTS = 5
_MIN_CLOUD_POINTS = 50
_PATCHWORK_MIN_RANGE_M = 1.0
_LOW_SHARE = 0.1
_REFLECTION_DEPTH_M = 0.5
_FILL_NEIGHBOURS = 8
_FILL_RADIUS_M = 2.0


def detect(points: np.ndarray, kept: np.ndarray, config: GroundConfig) -> np.ndarray:
    """Mask (N,) of the ground among the `kept` rows of points (N, 3), metres, z up, sensor frame."""
    ground = np.zeros(len(points), bool)
    rows = np.flatnonzero(kept)
    if len(rows) < _MIN_CLOUD_POINTS:
        return ground
    height_m = config.sensor_height_m or estimate_sensor_height(points[rows])
    if height_m is None:
        return ground
    shifted = points[rows].astype(np.float32)
    shifted[:, 2] += height_m - _PATCHWORK_HEIGHT_M
    found = rows[_patchwork(shifted)]
    ground[found] = _close_to_local_ground(points[found], config.max_height_m)
    return _filled(points, rows, ground, config.fill_height_m)


def estimate_sensor_height(points: np.ndarray) -> float | None:
    """Height in metres of the origin over the ground around it, None for a cloud without near points.

    The lowest points of cells around the sensor are ground where ground is seen; the lower quartile of
    those leaves out cells that only show walls.
    """
    near = points[np.hypot(points[:, 0], points[:, 1]) < _NEAR_M]
    lowest, counts, _ = _low_per_cell(near, 0.0)
    trusted = lowest[counts >= _MIN_CELL_POINTS]
    return float(-np.quantile(trusted, 0.25)) if len(trusted) else None


def reflections(points: np.ndarray, kept: np.ndarray, ground: np.ndarray) -> np.ndarray:
    """Mask (N,) of the `kept` points that lie clearly below the ground around them.

    No surface is there: the beam was mirrored by a car or a window, and the point moves with the mirror.
    """
    below = np.zeros(len(points), bool)
    if not ground.any():
        return below
    surface = points[ground]
    low = np.flatnonzero(kept & ~ground)
    low = low[points[low, 2] < np.median(surface[:, 2]) - _REFLECTION_DEPTH_M]
    if len(low):
        level = ground_level.around(*ground_level.flat_tree(surface), points[low], 1, np.inf)
        below[low] = points[low, 2] < level - _REFLECTION_DEPTH_M
    return below


def _close_to_local_ground(points: np.ndarray, max_height_m: float) -> np.ndarray:
    """Mask (N,) of the points at most `max_height_m` over the low ground of their cell.

    A low quantile, not the lowest point, which may be a reflection from under the road.
    """
    low, _, cell = _low_per_cell(points, _LOW_SHARE)
    slope_allowance_m = 0.1 * _CELL_M
    return points[:, 2] - low[cell] <= max_height_m + slope_allowance_m


def _filled(points: np.ndarray, rows: np.ndarray, ground: np.ndarray, height_m: float) -> np.ndarray:
    """`ground` with the other `rows` that lie within `height_m` of the ground around them.

    Patchwork++ judges whole patches and now and then drops one in the middle of the road; its points lie on
    rings that travel with the sensor and would pass for a moving object.
    """
    others = rows[~ground[rows]]
    if not ground.any() or len(others) == 0:
        return ground
    surface = points[ground]
    level = ground_level.around(
        *ground_level.flat_tree(surface), points[others], _FILL_NEIGHBOURS, _FILL_RADIUS_M)
    filled = ground.copy()
    filled[others] = np.abs(points[others, 2] - level) <= height_m   # not where the level is NaN
    return filled


def _low_per_cell(points: np.ndarray, share: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """z (C,) at `share` of the way up each cell (0: lowest), counts (C,), and cell (N,) of each point."""
    columns = np.floor(points[:, :2] / _CELL_M).astype(np.int64)
    columns -= columns.min(axis=0) if len(columns) else 0
    stride = columns[:, 1].max() + 1 if len(columns) else 1
    key = columns[:, 0] * stride + columns[:, 1]
    _, cell, counts = np.unique(key, return_inverse=True, return_counts=True)
    order = np.lexsort((points[:, 2], cell))
    first = np.cumsum(counts) - counts
    return points[order[first + (share * (counts - 1)).astype(int)], 2], counts, cell


def _patchwork(points: np.ndarray) -> np.ndarray:
    """Row numbers of the ground in points (N, 3) float32 of a sensor at Patchwork++'s own height."""
    import pypatchworkpp

    parameters = pypatchworkpp.Parameters()
    parameters.verbose = False
    parameters.enable_RNR = False   # noise removal by intensity: clouds here need not have any
    parameters.sensor_height = _PATCHWORK_HEIGHT_M
    parameters.min_range = _PATCHWORK_MIN_RANGE_M
    with _silent_stdout():
        estimator = pypatchworkpp.patchworkpp(parameters)
        estimator.estimateGround(np.column_stack([points, np.zeros(len(points), np.float32)]))
    return np.asarray(estimator.getGroundIndices(), np.int64)


@contextlib.contextmanager
def _silent_stdout():
    """Send the process's standard output to nowhere: the extension greets on it whatever `verbose` says."""
    sys.stdout.flush()
    saved, nowhere = os.dup(1), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 1)
        yield
    finally:
        os.dup2(saved, 1)
        os.close(saved)
        os.close(nowhere)

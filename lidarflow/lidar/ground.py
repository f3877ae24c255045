"""Ground points by Patchwork++ (Lee, Lim, Myung 2022), for sensors at any height."""

from dataclasses import dataclass

import numpy as np

from lidarflow import robust
from lidarflow.config import GroundConfig
from lidarflow.kernels import ground_level
from lidarflow.rows import every_few, median
from lidarflow.silence import silenced

_PATCHWORK_HEIGHT_M = 1.723   # the height Patchwork++ is tuned for; clouds are shifted to it
_PATCHWORK_MIN_RANGE_M = 1.0
_PATCHWORK_MAX_RANGE_M = 80.0   # bounds the area that cells are laid over
_CELL_M = 2.0                   # of the cells that low ground is looked for in
_NEAR_M = 20.0                  # ground this near to the sensor says how high it is
_MIN_CELL_POINTS = 5            # in a cell that has a say in that
_MIN_CLOUD_POINTS = 50          # in fewer no ground is looked for
_LOW_SHARE = 0.1                # of a cell's points may be lower than its low ground
_REFLECTION_DEPTH_M = 0.5       # what is deeper below the ground around it is a reflection
_FILL_NEIGHBOURS = 8            # ground points whose median says how high the ground around a place is
_FILL_RADIUS_M = 2.0            # if so many are this near
_PLANE_RADIUS_M = 15.0          # so far around the sensor ground is about a plane,
_PLANE_SCALE_M = 0.15           # to about so much,
_PLANE_POINTS = 1000            # which as many points tell as well as all
_PLANE_ROUNDS = 8
_BEND_RADIUS_M = 50.0           # of a road that rises from it: no street bends more


@dataclass(frozen=True, slots=True, eq=False)
class Ground:
    """The ground of a scan, and what it tells of other returns.

    mask        (N,) bool   on the ground
    reflection  (N,) bool   from clearly below it: no surface is there, the beam was mirrored by a car or a
                            window, and the point moves with the mirror
    """

    mask: np.ndarray
    reflection: np.ndarray

    @classmethod
    def none(cls, count: int) -> "Ground":
        """No ground among `count` points."""
        return cls(np.zeros(count, bool), np.zeros(count, bool))


def detect(points: np.ndarray, kept: np.ndarray, config: GroundConfig) -> Ground:
    """The ground among the `kept` rows of points (N, 3), metres, z up, sensor frame."""
    rows = np.flatnonzero(kept)
    if len(rows) < _MIN_CLOUD_POINTS:
        return Ground.none(len(points))
    height_m = config.sensor_height_m or estimate_sensor_height(points, rows)
    if height_m is None:
        return Ground.none(len(points))
    found = rows[_patchwork(ground_level.lifted(points, rows, height_m - _PATCHWORK_HEIGHT_M))]
    if len(found) == 0:
        return Ground.none(len(points))
    found = found[_close_to_local_ground(points, found, config.max_height_m)]
    found = found[_led_to(points.take(found, axis=0), config.max_height_m)]
    ground = Ground.none(len(points))
    ground.mask[found] = True
    around = ground_level.flat(points, found, _FILL_RADIUS_M)
    others = rows[~ground.mask[rows]]
    # Patchwork++ judges whole patches and now and then drops one in the middle of the road; its points lie on
    # rings that travel with the sensor and would pass for a moving object.
    is_filled = ground_level.is_level(around, points, others, _FILL_NEIGHBOURS, config.fill_height_m)
    ground.mask[others[is_filled]] = True
    others = others[~is_filled]
    low = others[points[others, 2] < median(around.points[:, 2]) - _REFLECTION_DEPTH_M]
    level = ground_level.around(around, points, low, 1, np.inf)
    ground.reflection[low] = points[low, 2] < level - _REFLECTION_DEPTH_M
    return ground


def estimate_sensor_height(points: np.ndarray, rows: np.ndarray) -> float | None:
    """Height in metres of the origin over the ground around it, None without near points.

    Of the `rows` of points (N, 3). The lowest points of cells around the sensor are ground where ground is
    seen; the lower quartile of those leaves out cells that only show walls.
    """
    lowest, counts = ground_level.lowest_per_cell(points, rows, _NEAR_M, _CELL_M)
    trusted = lowest[counts >= _MIN_CELL_POINTS]
    return float(-np.quantile(trusted, 0.25)) if len(trusted) else None


def _close_to_local_ground(points: np.ndarray, rows: np.ndarray, max_height_m: float) -> np.ndarray:
    """Mask (K,) of the rows (K,) of points at most `max_height_m` over the low ground of their cell.

    A low quantile, not the lowest point, which may be a reflection from under the road. A cell may slope.
    """
    slope_allowance_m = 0.1 * _CELL_M
    return ground_level.is_low(points, rows, _CELL_M, _LOW_SHARE, max_height_m + slope_allowance_m)


def _led_to(points: np.ndarray, max_height_m: float) -> np.ndarray:
    """Mask (K,) of the points (K, 3) that the ground under the sensor leads to.

    The bonnet of a car beside the sensor lies as flat as a road, and hides the road around it. But nothing
    leads up there: ground lies at most `max_height_m` over the plane around the sensor, and bends upwards.
    """
    x, y, z = points.T
    range_sq = x * x + y * y
    near = np.flatnonzero(range_sq < _PLANE_RADIUS_M**2)
    if len(near) < _MIN_CLOUD_POINTS:
        return np.ones(len(points), bool)
    by_x, by_y, level_m = _plane(points[near[every_few(len(near), _PLANE_POINTS)]])
    return z - (by_x * x + by_y * y + level_m) <= max_height_m + range_sq / (2.0 * _BEND_RADIUS_M)


def _plane(points: np.ndarray) -> np.ndarray:
    """Rise per metre along x and y, and height at the origin, of the plane that most points (N, 3) lie on."""
    rows, weight = np.column_stack([points[:, :2], np.ones(len(points))]), np.ones(len(points))
    for _ in range(_PLANE_ROUNDS):
        held = rows * weight[:, None]
        plane = np.linalg.lstsq(held.T @ rows, held.T @ points[:, 2])[0]
        _, weight = robust.geman_mcclure((points[:, 2] - rows @ plane) ** 2, _PLANE_SCALE_M)
    return plane


def _patchwork(points: np.ndarray) -> np.ndarray:
    """Row numbers of the ground in points (N, 4) float32, x y z 0, of a sensor at Patchwork++'s height."""
    import pypatchworkpp

    parameters = pypatchworkpp.Parameters()
    parameters.verbose = False
    parameters.enable_RNR = False   # noise removal by intensity: clouds here need not have any
    parameters.sensor_height = _PATCHWORK_HEIGHT_M
    parameters.min_range = _PATCHWORK_MIN_RANGE_M
    parameters.max_range = _PATCHWORK_MAX_RANGE_M
    with silenced(1):   # it greets, whatever `verbose` says
        estimator = pypatchworkpp.patchworkpp(parameters)
    estimator.estimateGround(points)
    return np.asarray(estimator.getGroundIndices(), np.int64)

"""The ground around a place: its slope and its heights."""

import math

import numpy as np

from lidarflow.kernels import stack
from lidarflow.kernels import tree as trees
from lidarflow.kernels.compiled import njit

_MIN_SPREAD = 1e-3   # ground narrower than this share of its length does not tell the slope across it


@njit()
def slope(ground, centre, radius_m):
    """Rise per metre along x and y of the plane through the ground within `radius_m` of `centre` (3,).

    `ground` is a tree. Least squares in height; also returns how many points there are.
    """
    found = np.empty(len(ground.rows), np.int64)
    count = trees.all_within(ground, centre[0], centre[1], centre[2], radius_m * radius_m, found)
    mean = np.zeros(3)
    for i in range(count):
        for k in range(3):
            mean[k] += ground.points[found[i], k] / count
    xx = xy = yy = xz = yz = 0.0
    for i in range(count):
        at = ground.points[found[i]]
        x, y, z = at[0] - mean[0], at[1] - mean[1], at[2] - mean[2]
        xx, xy, yy, xz, yz = xx + x * x, xy + x * y, yy + y * y, xz + x * z, yz + y * z
    along = 0.5 * math.atan2(2.0 * xy, xx - yy)   # of the longer axis
    by_x = by_y = 0.0
    longest = 0.0
    for turn in (along, along + 0.5 * math.pi):
        u, v = math.cos(turn), math.sin(turn)
        spread = xx * u * u + 2.0 * xy * u * v + yy * v * v
        longest = max(longest, spread)
        if spread > _MIN_SPREAD * _MIN_SPREAD * longest:
            rise = (xz * u + yz * v) / spread
            by_x, by_y = by_x + rise * u, by_y + rise * v
    return by_x, by_y, count


@njit()
def heights(ground, x, y, radius_m):
    """z (K,) of the ground's points no farther from x, y than `radius_m`, heights not counted."""
    found, count = np.empty(len(ground.rows)), 0
    leaves, radius_sq = len(ground.ends) // 2, radius_m * radius_m
    waiting = stack.integers()
    waiting[0], depth = 0, 1
    while depth > 0:
        depth -= 1
        node = waiting[depth]
        dx = max(max(ground.boxes[node, 0, 0] - x, x - ground.boxes[node, 1, 0]), 0.0)
        dy = max(max(ground.boxes[node, 0, 1] - y, y - ground.boxes[node, 1, 1]), 0.0)
        if dx * dx + dy * dy > radius_sq:
            continue
        if node < leaves:
            waiting[depth], waiting[depth + 1] = 2 * node + 1, 2 * node + 2
            depth += 2
            continue
        for i in range(ground.starts[node], ground.ends[node]):
            if (ground.points[i, 0] - x) ** 2 + (ground.points[i, 1] - y) ** 2 <= radius_sq:
                found[count] = ground.points[i, 2]
                count += 1
    return found[:count].copy()

"""How high the ground is around places: the median of its nearest points, seen from above.

All of it lies in square cells of dense arrays, which grow with the area that the points span.
"""

import math
from typing import NamedTuple

import numba
import numpy as np

from lidarflow.kernels import queue
from lidarflow.kernels.compiled import njit
from lidarflow.kernels.sorting import sort

_CHUNK = 2048       # places that one thread takes at a time; most are told by a glance
_BLOCK = 4          # cells along a side of a block, which is as wide as the reach
_NO, _YES, _UNKNOWN = 0, 1, 2


class Flat(NamedTuple):
    """Ground points seen from above, by cell; cell (i, j) has number i Y + j.

    cell_m          float
    first           (2,) int64   x and y of cell (0, 0), in cells
    points          (G, 3)       in the order of their cells
    starts          (X Y + 1,)   first point of each cell
    lowest          (X, Y)       of the heights in each cell
    highest         (X, Y)
    lowest_around   (B, C)       of the heights in each block and the eight around it; around all blocks is a
    highest_around  (B, C)       border of empty ones
    """

    cell_m: float
    first: np.ndarray
    points: np.ndarray
    starts: np.ndarray
    lowest: np.ndarray
    highest: np.ndarray
    lowest_around: np.ndarray
    highest_around: np.ndarray


def flat(points: np.ndarray, rows: np.ndarray, reach_m: float) -> Flat:
    """The `rows` (G,), at least one, of points (N, 3) as ground seen from above.

    Whoever asks `is_level` looks as far as `reach_m`.
    """
    cell_m = float(reach_m) / _BLOCK
    first, placed, starts, lowest, highest = _sorted_by_cell(np.ascontiguousarray(points), rows, cell_m)
    return Flat(cell_m, first, placed, starts, lowest, highest, *_around_blocks(lowest, highest))


def around(ground: Flat, points: np.ndarray, rows: np.ndarray, neighbours: int, reach_m: float) -> np.ndarray:
    """Median height (K,) of the `neighbours` nearest to each of the rows (K,) of points (N, 3).

    The points' own heights do not count. NaN where fewer are nearer than `reach_m`.
    """
    return _around(ground, np.ascontiguousarray(points), rows, neighbours, float(reach_m))


def is_level(
    ground: Flat, points: np.ndarray, rows: np.ndarray, neighbours: int, height_m: float
) -> np.ndarray:
    """Mask (K,) of the rows (K,) of points (N, 3) within `height_m` of the level that `around` finds.

    It looks as far as `ground` was made for; where fewer are that near, nothing is level.
    """
    return _is_level(ground, np.ascontiguousarray(points), rows, neighbours, float(height_m))


def lowest_per_cell(
    points: np.ndarray, rows: np.ndarray, near_m: float, cell_m: float
) -> tuple[np.ndarray, np.ndarray]:
    """Height of the lowest point of each cell (C,) within `near_m` of the origin, and how many it has (C,).

    Of the `rows` of points (N, 3); infinity and 0 where there are none.
    """
    return _lowest_per_cell(np.ascontiguousarray(points), rows, float(near_m), float(cell_m))


def is_low(
    points: np.ndarray, rows: np.ndarray, cell_m: float, share: float, height_m: float
) -> np.ndarray:
    """Mask (K,) of the rows (K,) of points (N, 3) at most `height_m` over what is low in their cell.

    That is the height at `share` of the way up the cell's points, 0 being the lowest.
    """
    return _is_low(np.ascontiguousarray(points), rows, float(cell_m), share, float(height_m))


def lifted(points: np.ndarray, rows: np.ndarray, lift_m: float) -> np.ndarray:
    """The rows (K,) of points (N, 3) higher by `lift_m`, and a zero after each: (K, 4) float32."""
    return _lifted(np.ascontiguousarray(points), rows, np.float32(lift_m))


@njit()
def _lifted(points, rows, lift_m):
    placed = np.empty((len(rows), 4), np.float32)
    for k in range(len(rows)):
        i = rows[k]
        placed[k, 0], placed[k, 1] = points[i, 0], points[i, 1]
        placed[k, 2], placed[k, 3] = np.float32(points[i, 2]) + lift_m, 0.0
    return placed


@njit()
def _lowest_per_cell(points, rows, near_m, cell_m):
    half = math.ceil(near_m / cell_m)
    lowest, counts = np.full(4 * half * half, np.inf), np.zeros(4 * half * half, np.int64)
    for i in rows:
        x, y = points[i, 0], points[i, 1]
        if x * x + y * y < near_m * near_m:
            cell = (math.floor(x / cell_m) + half) * 2 * half + math.floor(y / cell_m) + half
            lowest[cell] = min(lowest[cell], points[i, 2])
            counts[cell] += 1
    return lowest, counts


@njit()
def _is_low(points, rows, cell_m, share, height_m):
    _, shape, cell = _cells(points, rows, cell_m)
    lowest, highest = np.full(shape[0] * shape[1], np.inf), np.full(shape[0] * shape[1], -np.inf)
    for k in range(len(rows)):
        height = points[rows[k], 2]
        lowest[cell[k]], highest[cell[k]] = min(lowest[cell[k]], height), max(highest[cell[k]], height)
    _raise_to_share(points, rows, cell, share, highest - lowest > height_m, lowest)
    is_low = np.empty(len(rows), np.bool_)
    for k in range(len(rows)):
        is_low[k] = points[rows[k], 2] - lowest[cell[k]] <= height_m
    return is_low


@njit()
def _raise_to_share(points, rows, cell, share, is_steep, low):
    """Write into `low` (C,) the height at `share` of the way up each cell that is steep.

    Of other cells all is low, whichever of their heights counts.
    """
    ends = np.zeros(len(low), np.int64)
    for k in range(len(rows)):
        if is_steep[cell[k]]:
            ends[cell[k]] += 1
    total = 0
    for c in range(len(low)):
        total, ends[c] = total + ends[c], total
    heights = np.empty(total)
    for k in range(len(rows)):
        if is_steep[cell[k]]:
            heights[ends[cell[k]]] = points[rows[k], 2]
            ends[cell[k]] += 1
    start = 0
    for c in range(len(low)):
        if is_steep[c]:
            place = int(share * (ends[c] - start - 1))
            low[c] = np.partition(heights[start:ends[c]], place)[place]
            start = ends[c]


@njit()
def _cells(points, rows, cell_m):
    """The lowest cell (2,) along x and y, how many there are (2,), and the number (K,) of each row's."""
    low_x, low_y, high_x, high_y = np.inf, np.inf, -np.inf, -np.inf
    for i in rows:
        low_x, high_x = min(low_x, points[i, 0]), max(high_x, points[i, 0])
        low_y, high_y = min(low_y, points[i, 1]), max(high_y, points[i, 1])
    first_x, first_y = math.floor(low_x / cell_m), math.floor(low_y / cell_m)
    shape_x, shape_y = math.floor(high_x / cell_m) - first_x + 1, math.floor(high_y / cell_m) - first_y + 1
    cell = np.empty(len(rows), np.int64)
    for k in range(len(rows)):
        i = rows[k]
        x, y = math.floor(points[i, 0] / cell_m) - first_x, math.floor(points[i, 1] / cell_m) - first_y
        cell[k] = x * shape_y + y
    return np.array([first_x, first_y]), np.array([shape_x, shape_y]), cell


@njit()
def _sorted_by_cell(points, rows, cell_m):
    first, shape, cell = _cells(points, rows, cell_m)
    starts = np.zeros(shape[0] * shape[1] + 1, np.int64)
    for k in range(len(rows)):
        starts[cell[k] + 1] += 1
    for c in range(1, len(starts)):
        starts[c] += starts[c - 1]
    ends, placed = starts[:-1].copy(), np.empty((len(rows), 3))
    for k in range(len(rows)):
        place = ends[cell[k]]
        for axis in range(3):
            placed[place, axis] = points[rows[k], axis]
        ends[cell[k]] += 1
    lowest, highest = np.empty((shape[0], shape[1])), np.empty((shape[0], shape[1]))
    for x in range(shape[0]):
        for y in range(shape[1]):
            c, low, high = x * shape[1] + y, np.inf, -np.inf
            for i in range(starts[c], starts[c + 1]):
                low, high = min(low, placed[i, 2]), max(high, placed[i, 2])
            lowest[x, y], highest[x, y] = low, high
    return first, placed, starts, lowest, highest


@njit()
def _around_blocks(lowest, highest):
    """The lowest and highest (B, C) in each block of cells and the eight blocks around it."""
    shape = ((lowest.shape[0] - 1) // _BLOCK + 3, (lowest.shape[1] - 1) // _BLOCK + 3)
    low, high = np.full(shape, np.inf), np.full(shape, -np.inf)
    for x in range(lowest.shape[0]):
        for y in range(lowest.shape[1]):
            if lowest[x, y] <= highest[x, y]:      # not an empty cell
                block_x, block_y = x // _BLOCK + 1, y // _BLOCK + 1
                low[block_x, block_y] = min(low[block_x, block_y], lowest[x, y])
                high[block_x, block_y] = max(high[block_x, block_y], highest[x, y])
    low_around, high_around = np.empty(shape), np.empty(shape)
    for x in range(shape[0]):
        for y in range(shape[1]):
            low_around[x, y], high_around[x, y] = _range_around(low, high, x, y, 1)
    return low_around, high_around


@njit()
def _range_around(lowest, highest, x, y, width):
    """The lowest and highest of the cells at most `width` away from x, y along either axis."""
    low, high = np.inf, -np.inf
    for k in range(max(x - width, 0), min(x + width + 1, lowest.shape[0])):
        for j in range(max(y - width, 0), min(y + width + 1, lowest.shape[1])):
            low, high = min(low, lowest[k, j]), max(high, highest[k, j])
    return low, high


@njit(parallel=True)
def _around(ground, points, rows, neighbours, reach_m):
    levels = np.empty(len(rows))
    waiting = queue.tasks()
    for _ in numba.prange(queue.PLACES):
        chunk = queue.take(waiting)
        while chunk < (len(rows) + _CHUNK - 1) // _CHUNK:
            near_sq, near_heights = np.empty(neighbours), np.empty(neighbours)
            for k in range(chunk * _CHUNK, min((chunk + 1) * _CHUNK, len(rows))):
                x, y = points[rows[k], 0], points[rows[k], 1]
                levels[k] = _level(ground, x, y, reach_m * reach_m, near_sq, near_heights)
            chunk = queue.take(waiting)
    return levels


@njit(parallel=True)
def _is_level(ground, points, rows, neighbours, height_m):
    found, reach_sq = np.empty(len(rows), np.bool_), (_BLOCK * ground.cell_m) ** 2
    waiting = queue.tasks()
    for _ in numba.prange(queue.PLACES):
        chunk = queue.take(waiting)
        while chunk < (len(rows) + _CHUNK - 1) // _CHUNK:
            near_sq, near_heights = np.empty(neighbours), np.empty(neighbours)
            for k in range(chunk * _CHUNK, min((chunk + 1) * _CHUNK, len(rows))):
                x, y, z = points[rows[k], 0], points[rows[k], 1], points[rows[k], 2]
                told = _at_a_glance(ground, x, y, z, neighbours, height_m)
                if told == _UNKNOWN:
                    level = _level(ground, x, y, reach_sq, near_sq, near_heights)
                    found[k] = abs(z - level) <= height_m      # not where the level is NaN
                else:
                    found[k] = told == _YES
            chunk = queue.take(waiting)
    return found


@njit()
def _at_a_glance(ground, x, y, z, neighbours, height_m):
    """Whether the median of the nearest is within `height_m` of z, if the heights around leave no doubt."""
    i, j = math.floor(x / ground.cell_m) - ground.first[0], math.floor(y / ground.cell_m) - ground.first[1]
    block_x, block_y = i // _BLOCK + 1, j // _BLOCK + 1
    blocks = ground.lowest_around.shape
    if block_x < 0 or block_y < 0 or block_x >= blocks[0] or block_y >= blocks[1]:
        return _NO
    if z - ground.lowest_around[block_x, block_y] < -height_m:
        return _NO
    if z - ground.highest_around[block_x, block_y] > height_m:
        return _NO
    if i < 0 or j < 0 or i >= ground.lowest.shape[0] or j >= ground.lowest.shape[1]:
        return _UNKNOWN
    cell = i * ground.lowest.shape[1] + j
    if ground.starts[cell + 1] - ground.starts[cell] < neighbours:
        return _UNKNOWN
    # The nearest are at most as far as the cell's own points, less than two cells.
    low, high = _range_around(ground.lowest, ground.highest, i, j, 2)
    if z - low < -height_m or z - high > height_m:
        return _NO
    return _YES if z - low <= height_m and z - high >= -height_m else _UNKNOWN


@njit()
def _level(ground, x, y, reach_sq, near_sq, near_heights):
    """Median height of the nearest, NaN where not so many are in reach; the last two are room for them."""
    _find_nearest(ground, x, y, reach_sq, near_sq, near_heights)
    count = len(near_heights)
    if math.isnan(near_heights[count - 1]):
        return np.nan
    sort(near_heights)
    return 0.5 * (near_heights[(count - 1) // 2] + near_heights[count // 2])


@njit()
def _find_nearest(ground, x, y, reach_sq, near_sq, near_heights):
    """Fill squared distances and heights of the nearest, ascending in distance; missing ones are NaN high.

    Of equally far ones the lower comes first, so that the order of the points does not matter.

    Squares of cells around the place grow until what lies outside is farther than what was found.
    """
    near_sq[:], near_heights[:] = reach_sq, np.nan
    columns, cells = ground.lowest.shape
    own_x, own_y = math.floor(x / ground.cell_m), math.floor(y / ground.cell_m)
    off_x, off_y = x - own_x * ground.cell_m, y - own_y * ground.cell_m
    margin_m = min(min(off_x, ground.cell_m - off_x), min(off_y, ground.cell_m - off_y))
    i, j = own_x - ground.first[0], own_y - ground.first[1]
    farthest = max(max(i, columns - 1 - i), max(j, cells - 1 - j))
    seen, width = -1, 0
    while True:
        low, high = max(j - width, 0), min(j + width + 1, cells)
        for column in range(max(i - width, 0), min(i + width + 1, columns)):
            if abs(column - i) > seen:
                _take(ground, column, low, high, x, y, near_sq, near_heights)
            else:
                _take(ground, column, low, min(j - seen, cells), x, y, near_sq, near_heights)
                _take(ground, column, max(j + seen + 1, 0), high, x, y, near_sq, near_heights)
        if width >= farthest or (margin_m + width * ground.cell_m) ** 2 > near_sq[-1]:
            return
        seen, width = width, width + 1 + width // 4      # what is far off is not looked for cell by cell


@njit()
def _take(ground, column, low, high, x, y, near_sq, near_heights):
    """Put the points of cells low..high of a column that are nearer than the last among the nearest."""
    if low >= high:
        return
    last, base = len(near_sq) - 1, column * ground.lowest.shape[1]
    off_x = _outside(x, ground.first[0] + column, ground.first[0] + column + 1, ground.cell_m)
    off_y = _outside(y, ground.first[1] + low, ground.first[1] + high, ground.cell_m)
    if off_x * off_x + off_y * off_y > near_sq[last]:
        return
    for i in range(ground.starts[base + low], ground.starts[base + high]):
        dx, dy, height = ground.points[i, 0] - x, ground.points[i, 1] - y, ground.points[i, 2]
        apart_sq = dx * dx + dy * dy
        if not _comes_before(apart_sq, height, near_sq[last], near_heights[last]):
            continue
        k = last
        while k > 0 and _comes_before(apart_sq, height, near_sq[k - 1], near_heights[k - 1]):
            near_sq[k], near_heights[k] = near_sq[k - 1], near_heights[k - 1]
            k -= 1
        near_sq[k], near_heights[k] = apart_sq, height


@njit(inline="always")
def _outside(place, low, high, cell_m):
    """How far a place lies outside of the cells low..high along an axis, 0 inside."""
    return max(max(low * cell_m - place, place - high * cell_m), 0.0)


@njit(inline="always")
def _comes_before(apart_sq, height, other_sq, other_height):
    """The nearer first, of equally far ones the lower; nothing as far as the reach before a missing one."""
    return apart_sq < other_sq or (apart_sq == other_sq and height < other_height)

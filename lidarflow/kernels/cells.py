"""Points by the cells of a uniform grid, which are found by hashing."""

import math
from typing import NamedTuple

import numpy as np

from lidarflow.kernels.compiled import njit

NEAR = 27     # cells around one, itself among them


class Cells(NamedTuple):
    """Points gathered by cell, and cells by column.

    cell_m   float            size of a cell
    place    (C, 3) int64     of each occupied cell: the floor of coordinates over cell_m
    order    (N,) int64       rows of the points, cell by cell, ascending in each
    bounds   (C + 1,) int64   where each cell begins in this order, and the end
    table    (S, 4) int32     hash table of the columns that hold cells: x, y, 0 and which, -1 = empty
    stacked  (C,) int64       cells, column by column, each from the lowest up
    stacks   (D + 1,) int64   where each column begins among them, and the end
    """

    cell_m: float
    place: np.ndarray
    order: np.ndarray
    bounds: np.ndarray
    table: np.ndarray
    stacked: np.ndarray
    stacks: np.ndarray


def build(points: np.ndarray, cell_m: float) -> Cells:
    """The cells of finite points (N, 3), in the order they first appear."""
    return Cells(*_built(np.ascontiguousarray(points, float), float(cell_m)))


@njit()
def _built(points, cell_m):
    return built(points, cell_m)[:]


@njit()
def built(points, cell_m):
    """As `build`, for other kernels."""
    place, number, counts = _hashed(points, cell_m)
    order, bounds = by_number(number, counts)
    table, column, heights = _columns(place)
    stacked, stacks = by_number(column, heights)
    for k in range(len(heights)):
        _sort_by_height(stacked[stacks[k]: stacks[k + 1]], place)
    return Cells(cell_m, place, order, bounds, table, stacked, stacks)


@njit()
def by_number(number, counts):
    """Rows (N,) by their number, ascending in each, and where each of the numbers begins, and the end."""
    bounds = np.zeros(len(counts) + 1, np.int64)
    bounds[1:] = np.cumsum(counts)
    order, filled = np.empty(len(number), np.int64), bounds[:-1].copy()
    for i in range(len(number)):
        order[filled[number[i]]] = i
        filled[number[i]] += 1
    return order, bounds


@njit()
def _sort_by_height(cells, place):
    """Sort the few cells of a column from the lowest up."""
    for k in range(1, len(cells)):
        cell, at = cells[k], k
        while at > 0 and place[cells[at - 1], 2] > place[cell, 2]:
            cells[at] = cells[at - 1]
            at -= 1
        cells[at] = cell


@njit()
def numbered(points, cell_m):
    """The number (N,) of each point's cell, in the order they first appear, and how many each has (C,)."""
    _, number, counts = _hashed(points, cell_m)
    return number, counts


@njit()
def around(cells, place, near):
    """Fill `near` (NEAR,) with the occupied cells that touch the one at `place` (3,); returns how many.

    Nine columns are looked up: that most cells around one are empty makes looking for each of them slow.
    """
    count = 0
    for x in range(place[0] - 1, place[0] + 2):
        for y in range(place[1] - 1, place[1] + 2):
            column = cells.table[_slot(x, y, 0, cells.table), 3]
            if column < 0:
                continue
            for k in range(cells.stacks[column], cells.stacks[column + 1]):
                cell = cells.stacked[k]
                above = cells.place[cell, 2] - place[2]
                if above > 1:
                    break
                if above >= -1:
                    near[count] = cell
                    count += 1
    return count


@njit()
def _hashed(points, cell_m):
    """Places (C, 3) of the cells of points, the cell (N,) of each, and how many points each has (C,)."""
    table, place = _room(len(points)), np.empty((len(points), 3), np.int64)
    number, counts = np.empty(len(points), np.int64), np.zeros(len(points), np.int64)
    found, cell, lx, ly, lz = 0, -1, 0, 0, 0
    for i in range(len(points)):
        x = math.floor(points[i, 0] / cell_m)
        y = math.floor(points[i, 1] / cell_m)
        z = math.floor(points[i, 2] / cell_m)
        # Points that follow one another are often in one cell.
        if cell < 0 or x != lx or y != ly or z != lz:
            lx, ly, lz = x, y, z
            cell = _entered(x, y, z, table, found)
            if cell == found:
                place[cell, 0], place[cell, 1], place[cell, 2] = x, y, z
                found += 1
        number[i] = cell
        counts[cell] += 1
    return place[:found].copy(), number, counts[:found].copy()


@njit()
def _columns(place):
    """A table of the columns of places (C, 3), the column (C,) of each, and how many each has (D,)."""
    table = _room(len(place))
    number, counts, found = np.empty(len(place), np.int64), np.zeros(len(place), np.int64), 0
    for i in range(len(place)):
        number[i] = _entered(place[i, 0], place[i, 1], 0, table, found)
        found = max(found, number[i] + 1)
        counts[number[i]] += 1
    return table, number, counts[:found].copy()


@njit()
def _room(count):
    """An empty hash table (S, 4) for as many cells."""
    slots = 16
    while slots < 2 * count:
        slots *= 2
    table = np.empty((slots, 4), np.int32)
    table[:, 3] = -1
    return table


@njit(inline="always")
def _entered(x, y, z, table, found):
    """Number of the cell at x, y, z; the next, `found`, if it was not in the table yet."""
    slot = _slot(x, y, z, table)
    if table[slot, 3] < 0:
        table[slot, 0], table[slot, 1], table[slot, 2], table[slot, 3] = x, y, z, found
    return np.int64(table[slot, 3])


@njit(inline="always")
def _slot(x, y, z, table):
    """Slot of a table that has the cell at x, y, z, or would have it.

    Large primes spread cells (Teschner et al. 2003); what is above is folded into the low bits.
    """
    mixed = (x * 73856093) ^ (y * 19349663) ^ (z * 83492791)
    slot = (mixed ^ (mixed >> 17)) & (len(table) - 1)
    while table[slot, 3] >= 0 and (table[slot, 0] != x or table[slot, 1] != y or table[slot, 2] != z):
        slot = (slot + 1) & (len(table) - 1)
    return slot

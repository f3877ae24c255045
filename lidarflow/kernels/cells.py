"""Points by the cells of a uniform grid, which are found by hashing."""

import math
from typing import NamedTuple

import numpy as np

from lidarflow.kernels.compiled import njit

NEAR = 27     # cells around one, itself among them


class Cells(NamedTuple):
    """Points gathered by cell.

    cell_m  float            size of a cell
    place   (C, 3) int64     of each occupied cell: the floor of coordinates over cell_m
    table   (S,) int32       cell in each slot of the hash table, -1 = empty
    order   (N,) int64       rows of the points, cell by cell, ascending in each
    bounds  (C + 1,) int64   where each cell begins in this order, and the end
    """

    cell_m: float
    place: np.ndarray
    table: np.ndarray
    order: np.ndarray
    bounds: np.ndarray


def build(points: np.ndarray, cell_m: float) -> Cells:
    """The cells of finite points (N, 3), in the order they first appear."""
    return built(np.ascontiguousarray(points, float), float(cell_m))


@njit()
def built(points, cell_m):
    """As `build`, for other kernels."""
    place, table, number, counts = _hashed(points, cell_m)
    bounds = np.zeros(len(counts) + 1, np.int64)
    bounds[1:] = np.cumsum(counts)
    order, filled = np.empty(len(points), np.int64), bounds[:-1].copy()
    for i in range(len(points)):
        order[filled[number[i]]] = i
        filled[number[i]] += 1
    return Cells(cell_m, place, table, order, bounds)


@njit()
def numbered(points, cell_m):
    """The number (N,) of each point's cell, in the order they first appear, and how many each has (C,)."""
    _, _, number, counts = _hashed(points, cell_m)
    return number, counts


@njit()
def around(cells, place, near):
    """Fill `near` (NEAR,) with the occupied cells that touch the one at `place` (3,); returns how many."""
    count = 0
    for x in range(place[0] - 1, place[0] + 2):
        for y in range(place[1] - 1, place[1] + 2):
            for z in range(place[2] - 1, place[2] + 2):
                cell = cells.table[_slot(x, y, z, cells.table, cells.place)]
                if cell >= 0:
                    near[count] = cell
                    count += 1
    return count


@njit()
def _hashed(points, cell_m):
    slots = 16
    while slots < 2 * len(points):
        slots *= 2
    table, place = np.full(slots, -1, np.int32), np.empty((len(points), 3), np.int64)
    number, counts = np.empty(len(points), np.int64), np.zeros(len(points), np.int64)
    found, cell = 0, -1
    for i in range(len(points)):
        x = math.floor(points[i, 0] / cell_m)
        y = math.floor(points[i, 1] / cell_m)
        z = math.floor(points[i, 2] / cell_m)
        # Points that follow one another are often in one cell.
        if cell < 0 or place[cell, 0] != x or place[cell, 1] != y or place[cell, 2] != z:
            slot = _slot(x, y, z, table, place)
            if table[slot] < 0:
                table[slot] = found
                place[found, 0], place[found, 1], place[found, 2] = x, y, z
                found += 1
            cell = table[slot]
        number[i] = cell
        counts[cell] += 1
    return place[:found].copy(), table, number, counts[:found].copy()


@njit(inline="always")
def _slot(x, y, z, table, place):
    """Slot of a table that has the cell at x, y, z, or would have it.

    Large primes spread cells (Teschner et al. 2003); what is above is folded into the low bits.
    """
    mixed = (x * 73856093) ^ (y * 19349663) ^ (z * 83492791)
    slot = (mixed ^ (mixed >> 17)) & (len(table) - 1)
    while table[slot] >= 0:
        cell = table[slot]
        if place[cell, 0] == x and place[cell, 1] == y and place[cell, 2] == z:
            break
        slot = (slot + 1) & (len(table) - 1)
    return slot

"""Numbers of many points side by side, so that loops over them compile to vector instructions.

A block holds rows of WIDTH numbers, a row for each number of a point: WIDTH points stand beside one another
in its columns, the next WIDTH in the next rows. Sums have rows of the same width, one for each sum; every
lane adds up its own column, and lanes are added in order in the end. So the order of additions is fixed, as
it would not be if the compiler were free to choose it. Short offsets are held in single precision.
"""

import numpy as np

from lidarflow.kernels import cells
from lidarflow.kernels.compiled import njit

WIDTH = 16
FAR = np.float32(1e9)    # an offset that is outside any radius, where a block has no point


@njit()
def blocks(rows, count):
    """Room for `count` points with so many rows each."""
    return np.empty(rows * padded(count), np.float32)


@njit(inline="always")
def padded(count):
    """How many columns as many points take: the next multiple of WIDTH."""
    return (count + WIDTH - 1) // WIDTH * WIDTH


@njit(inline="always")
def column(rows, k):
    """Where the first row of the k-th point is; the next ones are WIDTH further on."""
    return rows * WIDTH * (k // WIDTH) + k % WIDTH


@njit()
def gathered_around(numbers, seen, place, near, corner):
    """A block of the points in and around the cell at `place` (3,) of `seen`, as offsets from its corner.

    Fills `near` (cells.NEAR,) with these cells, and the corner (3,).
    """
    for k in range(3):
        corner[k] = place[k] * seen.cell_m
    found = cells.around(seen, place, near)
    return gathered(numbers, seen, near[:found], corner)


@njit()
def gathered(numbers, seen, near, corner):
    """A block of the points in some cells `near` (K,) of `seen`.

    The first three of their numbers (N, rows) are where they are, of which a corner (3,) is taken away.
    """
    rows, count = numbers.shape[1], 0
    for cell in near:
        count += seen.bounds[cell + 1] - seen.bounds[cell]
    block, count = blocks(rows, count), 0
    for cell in near:
        for place in range(seen.bounds[cell], seen.bounds[cell + 1]):
            at, own = column(rows, count), numbers[seen.order[place]]
            for k in range(rows):
                block[at + k * WIDTH] = own[k] - corner[k] if k < 3 else own[k]
            count += 1
    pad(block, rows, count)
    return block


@njit()
def pad(block, rows, count):
    """Fill the columns behind `count` points; the first number of each is FAR, others are 0."""
    for k in range(count, padded(count)):
        at = column(rows, k)
        block[at] = FAR
        for row in range(1, rows):
            block[at + row * WIDTH] = 0.0


@njit(inline="always")
def total(sums, row):
    """What the lanes of a row of sums add up to."""
    added = np.float32(0.0)
    for lane in range(WIDTH):
        added += sums[row * WIDTH + lane]
    return np.float64(added)
